"""What is rendered, and from where: Gaussians, cameras, view-dependent colors, the pyramid of a view."""
