"""What is rendered, and from where: Gaussians, cameras, view-dependent colours, the pyramid of a view."""
