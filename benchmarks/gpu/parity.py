"""Comparison of every available rasterizer (image, coverage, color gradient) and of repeated steps."""

from __future__ import annotations

from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes, device
from sgsst_core.bench.device_checks import BACKGROUND, Step, rasterizer_checks
from sgsst_core.bench.synthetic import surface_scene, views
from sgsst_core.rasterizer import drawing_problem, make_rasterizer


def run(sizes: Sizes, findings: Findings) -> None:
    """Compare all available rasterizers on one view. Raise an error if `triton` is unavailable."""
    gaussians, width, height = sizes.parity
    scene, camera = surface_scene(gaussians, degree=3), views(1, width, height)[0]
    if problem := drawing_problem("triton", device()):
        raise RuntimeError(f"rasterizer 'triton': {problem}")
    for name in ("triton", "cached"):
        rasterizer = make_rasterizer(name, scene, background=BACKGROUND, device=device())
        for check in rasterizer_checks(rasterizer, scene, camera):
            findings.check(f"{name}/{check.name}", check.error, check.bound)
        step = Step.of(rasterizer, scene, camera, small_weights() if sizes == QUICK else network_weights())
        findings.check(f"{name}/different_of_{sizes.bits}_repeats", step.different_repeats(sizes.bits), 0.0)
