"""The command line: Hydra entry points and nothing else."""
