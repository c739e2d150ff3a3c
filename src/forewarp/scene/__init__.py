"""The nouns: boxes, cameras, rays, frames, batches and what a method answers."""
