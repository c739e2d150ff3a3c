"""Tests, mirroring src/forewarp, and what they share."""
