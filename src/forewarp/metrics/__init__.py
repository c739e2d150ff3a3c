"""Metrics of images, depth maps and motion, by the conventions of the papers."""
