"""Measure and draw what was fitted: test views, videos, trajectories, accuracy against time."""
