"""Procedural moving scenes with exact images, depth and trajectories."""
