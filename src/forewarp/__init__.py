"""Reconstruct a moving scene from images by forward warping a canonical radiance field."""
