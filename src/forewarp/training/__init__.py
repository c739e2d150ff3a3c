"""Train a method: objective, schedules, the Lightning module, stages, checkpoints, what is shown."""
