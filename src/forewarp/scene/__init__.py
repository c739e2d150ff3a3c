"""Data types: boxes, cameras, rays, frames, batches, views and renderings."""
