"""Refinement: split Gaussians that are large in the views into smaller ones."""
