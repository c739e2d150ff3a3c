"""Canonical matter in voxels, warped forward or backward: the paper's method and its opponent."""
