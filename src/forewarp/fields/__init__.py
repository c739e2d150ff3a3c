"""What several methods learn: voxel grids, radiance, trajectories, networks."""
