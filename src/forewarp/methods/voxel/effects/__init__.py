"""The effects of the voxel methods: motion, up-sampling, inpainting, view dependence, background."""
