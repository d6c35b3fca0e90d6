"""Scene representation: Gaussians, cameras, view-dependent colors and the image pyramid."""
