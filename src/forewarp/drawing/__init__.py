"""Pixels: colours for depth, error and flow, lines over pictures, files."""
