"""A page in the browser that flies around a fitted scene, or one in training, and through its time."""
