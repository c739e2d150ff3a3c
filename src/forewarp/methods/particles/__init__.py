"""Canonical Gaussian particles, moved forward by nodes and rasterised."""
