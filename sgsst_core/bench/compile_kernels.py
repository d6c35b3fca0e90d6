"""Compile the kernels that jobs use: `python -m sgsst_core.bench.compile_kernels`.

They are cached on disk. Otherwise the first job on a machine compiles them, and so does each of the service's confined
processes, which cannot write the cache.
"""

from __future__ import annotations

import torch

from sgsst_core.bench.synthetic import random_weights, surface_scene, texture, views
from sgsst_core.features import winograd
from sgsst_core.stylizing.loop import stylize


def compile_kernels() -> None:
    """Stylize small scenes without and with spherical harmonics for two steps, and convolve as wide networks do."""
    weights, style = random_weights("vgg16", (16,) * 5), texture(32, 32, seed=3)
    for degree in (0, 1):
        scene = surface_scene(200, degree=degree)
        stylize(scene, views(2, 48, 32), style, weights=weights, preset="preview", steps_sos=2)
    winograd.convolve(torch.zeros((1, 64, 8, 8)), torch.zeros((36, 64, 64)))


if __name__ == "__main__":
    torch.set_num_threads(1)
    compile_kernels()
