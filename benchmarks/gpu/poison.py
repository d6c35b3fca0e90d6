"""Steps in memory that held NaN, and fused convolutions at small and full size."""

from __future__ import annotations

import torch

from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes, device
from sgsst_core.bench.device_checks import BACKGROUND, CheckSizes, Step, check_device, leave_nan
from sgsst_core.bench.synthetic import surface_scene, texture, views
from sgsst_core.features.vgg import FeatureNetwork, has_bfloat16
from sgsst_core.rasterizer import make_rasterizer


def run(sizes: Sizes, findings: Findings) -> None:
    """Run the checks of `sgsst doctor`, then steps and convolutions at the size of views."""
    quick = sizes == QUICK
    for check in check_device("triton", device(), CheckSizes(100, 32, 24, 2, 16) if quick else CheckSizes()):
        findings.check(f"small/{check.name.replace(' ', '_')}", check.error, check.bound)
    weights = small_weights() if quick else network_weights()
    gaussians, (width, height) = sizes.gaussians[0], sizes.view
    scene, camera = surface_scene(gaussians, degree=1), views(1, width, height)[0]
    rasterizer = make_rasterizer("triton", scene, background=BACKGROUND, device=device())
    for dtype in (torch.bfloat16, torch.float32) if has_bfloat16(device()) and not quick else (torch.float32,):
        name = str(dtype).removeprefix("torch.")
        step = Step.of(rasterizer, scene, camera, weights, dtype)
        findings.check(f"{width}x{height}/{name}/values_changed_by_nan", step.changed_by_nan(), 0.0)
        network = FeatureNetwork(weights, dtype=dtype, device=device())
        findings.add(f"fused_convolutions/{name}/small", network.fused_layers)
        image = texture(height, width).to(device())
        leave_nan(device())
        network.forward(image, cache=False)
        findings.add(f"fused_convolutions/{name}/{width}x{height}", network.fused_layers)
