"""Moving Gaussians in one binary glTF file: its container, its compression, its writer and its reader."""
