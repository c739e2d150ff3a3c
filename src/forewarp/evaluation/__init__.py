"""Measure and draw fitted scenes: test views, videos, trajectories, accuracy against time."""
