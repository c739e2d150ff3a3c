"""The optional parts of a scene: motion, up-sampling, inpainting, view dependence."""
