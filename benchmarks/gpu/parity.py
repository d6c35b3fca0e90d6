"""Comparison of every available rasterizer (image, coverage, color gradient) with `reference` in float64."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.gpu.inputs import surface_scene, views
from benchmarks.gpu.part import Findings, Sizes, device
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.rasterizer.trial import drawing_problem
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

#: By rasterizer: relative distance from an alpha or transmittance cutoff within which float32 rounding may change the
#: decision, then error bounds for images and for gradients. They are larger for gsplat, which projects in float32 and
#: uses the fast exponential intrinsic.
RASTERIZERS: dict[str, tuple[float, float, float]] = {
    "triton": (2e-5, 1e-5, 5e-6),
    "cached": (2e-5, 1e-5, 5e-6),
    "cuda": (2e-3, 1e-4, 1e-4),
}
BACKGROUND = (1.0, 0.25, 0.5)


def run(sizes: Sizes, found: Findings) -> None:
    """Compare all available rasterizers on one view. Raise an error if `triton` is unavailable."""
    gaussians, width, height = sizes.parity
    scene, camera = surface_scene(gaussians, degree=3), views(1, width, height)[0]
    for name, bounds in RASTERIZERS.items():
        problem = drawing_problem(name, device())
        if problem and name == "triton":
            raise RuntimeError(f"rasterizer 'triton': {problem}")
        if problem:
            found.add(name, {"skipped": problem})
            continue
        compare(make_rasterizer(name, scene, background=BACKGROUND, device=device()), scene, camera, bounds, found)


def compare(
    fast: Rasterizer, scene: Scene, camera: Camera, bounds: tuple[float, float, float], found: Findings
) -> None:
    """Compare with the reference, except at pixels very close to a cutoff; count those on the other side of it."""
    close, image_bound, gradient_bound = bounds
    alpha_max = getattr(fast, "alpha_max", None)
    options = {} if alpha_max is None else {"alpha_max": alpha_max}
    reference = ReferenceRasterizer(scene, background=BACKGROUND, **options)
    colors = scene_colors(scene, camera)
    pixels = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    band = reference.near_cutoff(camera, close)
    pixels[band] = 0
    image = _off(fast.render(colors, camera), reference.render(colors, camera)).amax(-1)
    coverage = _off(fast.coverage(camera), reference.coverage(camera))
    expected = reference.color_gradient(pixels, camera)
    gradient = float(_off(fast.color_gradient(pixels, camera), expected).norm() / expected.norm())
    brightest = max(1.0, float(colors.max()))
    found.check(f"{fast.name}/image", float(image[~band].max()) / brightest, image_bound)
    found.check(f"{fast.name}/coverage", float(coverage[~band].max()), image_bound)
    found.check(f"{fast.name}/gradient", gradient, gradient_bound)
    found.add(f"{fast.name}/pixels_with_a_step", int((image > image_bound * brightest).sum()))


def _off(found: Tensor, expected: Tensor) -> Tensor:
    return (found.cpu().double() - expected).abs()
