"""Configurations, found with ``hydra.searchpath=[pkg://theirs.conf]`` or ``--config-dir``."""
