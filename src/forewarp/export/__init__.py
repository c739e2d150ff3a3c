"""A fitted scene as files that other programs read."""
