"""Nodes of ComfyUI that stylize its Gaussian splats with its images on a service of sgsst."""

from .nodes import comfy_entrypoint

__all__ = ["comfy_entrypoint"]
