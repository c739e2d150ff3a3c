"""What is learned: radiance and trajectories on a canonical lattice."""
