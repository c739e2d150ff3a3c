"""Radiance on a canonical voxel grid, warped forward (the paper's method) or backward (the baseline)."""
