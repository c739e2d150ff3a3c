"""Make a run from its config, and find its config, lock, data and trust in its folder."""
