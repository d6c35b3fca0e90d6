"""Tests of render modes: against a renderer that shares no code, and of the compensation itself."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene
from sgsst_core.rasterizer import RASTERIZERS, make_rasterizer
from sgsst_core.rasterizer.projection import Column, project
from sgsst_core.rasterizer.reference import splat
from sgsst_core.scene.camera import resized
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.sgsst_core.rasterizer import independent
from tests.sgsst_core.splat_scenes import camera, cloud, colors_of, rotated_pose, single, together

CPU = [name for name, kind in RASTERIZERS.items() if not kind.on_gpu]
RENDERINGS = [CLASSIC, Rendering("antialiased"), Rendering("antialiased", 0.1), Rendering("classic", 0.1)]
texts = pytest.mark.parametrize("rendering", RENDERINGS, ids=lambda rendering: rendering.text)


@texts
@pytest.mark.parametrize("log_scale", [-2.5, -4.5])
def test_rasterizers_agree_with_an_independent_renderer(rendering: Rendering, log_scale: float) -> None:
    scene, view = cloud(500, log_scale=log_scale), camera(34, 25, focal=30.0, pose=rotated_pose())
    colors = colors_of(scene) / 2
    expected = independent.render(
        scene, view, colors.double().numpy(), antialiased=rendering.antialiased, eps2d=rendering.eps2d
    )
    assert expected.max() > 0.05
    for name in CPU:
        image = make_rasterizer(name, replace(scene, rendering=rendering)).render(colors, view)
        assert independent.psnr(image.double().numpy(), expected) > 60, name


@pytest.mark.slow
@texts
def test_real_scene_agrees_with_an_independent_renderer(shared_data: Path, rendering: Rendering) -> None:
    folder = shared_data / "scenes/snowmiku_plush"
    scene = replace(read_scene(folder / "point_cloud.ply").scene, rendering=rendering)
    view = resized(read_cameras(folder / "cameras.json")[3], 62)
    colors = (0.5 + 0.28209479177387814 * scene.sh_dc).clamp(0, 1)
    expected = independent.render(
        scene, view, colors.double().numpy(), antialiased=rendering.antialiased, eps2d=rendering.eps2d
    )
    for name in CPU:
        image = make_rasterizer(name, scene).render(colors, view)
        assert independent.psnr(image.double().numpy(), expected) > 60, name


def test_small_gaussians_keep_their_weight_at_every_resolution() -> None:
    """Without compensation, a Gaussian far smaller than a pixel gets the weight of the blur."""
    scene = single((0, 0, 4), scales=(0.005,) * 3)
    sums = {}
    for rendering in (CLASSIC, Rendering("antialiased")):
        cpu = make_rasterizer("cpu", replace(scene, rendering=rendering))
        sums[rendering.mode] = [
            float(cpu.coverage(camera(9 * n, 9 * n, focal=90.0 * n)).sum()) / n**2 for n in (3, 6, 12)
        ]
    small, _, large = sums["antialiased"]
    assert small == pytest.approx(large, rel=0.05)
    small, _, large = sums["classic"]
    assert small > 2.5 * large


@pytest.mark.parametrize("length", [1.0, 1e3, 1e6])
def test_compensation_matches_exact_arithmetic(length: float) -> None:
    """The plain formula p r - q^2 would have no correct digit for a needle."""
    view, width = camera(focal=64.0), length * 1e-6
    scene = single((0.0, 0.0, 4.0), scales=(length, width, width), quat=(math.cos(0.3), 0, 0, math.sqrt(0.5)))
    scene = replace(scene, opacities=torch.tensor([20.0]), rendering=Rendering("antialiased", 0.1))
    w, _, _, z = (Fraction(float(v)) for v in scene.quats[0])
    n2 = w * w + z * z
    cos, sin = (w * w - z * z) / n2, 2 * w * z / n2
    s = [Fraction(float(v)) for v in scene.scales[0].double().exp()]
    fx, fy, eps = Fraction(view.fx) / 4, Fraction(view.fy) / 4, Fraction(0.1)
    m0, m1 = (fx * cos * s[0], -fx * sin * s[1]), (fy * sin * s[0], fy * cos * s[1])
    p, q, r = m0[0] ** 2 + m0[1] ** 2, m0[0] * m1[0] + m0[1] * m1[1], m1[0] ** 2 + m1[1] ** 2
    expected = math.sqrt(float((p * r - q * q) / ((p + eps) * (r + eps) - q * q)))
    opacity = float(scene.opacities.double().sigmoid()) * expected
    if opacity < 1 / 255:
        assert not len(project(scene, view).gaussians)
        return
    assert 2 ** project(scene, view).values[0][Column.LOG2_OPACITY] == pytest.approx(opacity, rel=1e-9)
    assert float(splat(scene, view).opacity[0]) == pytest.approx(opacity, rel=1e-9)


def test_extreme_shapes_are_drawn_or_dropped() -> None:
    """Gaussians without thickness, edge-on, without any extent, and beyond the range of float64."""
    at, upright = (0.0, 0.0, 4.0), (1.0, 0.0, 0.0, 0.0)
    sideways = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # the thin axis lies in the image plane
    scene = together(
        [
            (at, 0.8, (0.5, 0.5, 1e-30), upright),
            (at, 0.8, (0.5, 0.5, 1e-30), sideways),
            (at, 0.8, (1e-30, 1e-30, 1e-30), upright),
            (at, 0.8, (1.0, 1.0, 1.0), upright),
        ]
    )
    scene.scales[3] = 500
    scene = replace(scene, rendering=Rendering("antialiased"))
    projection = project(scene, camera())
    assert projection.gaussians.tolist() == [0]
    assert splat(scene, camera()).gaussians.tolist() == [0]
    assert np.isfinite(projection.values).all()
    assert np.isfinite(make_rasterizer("cpu", scene).coverage(camera()).numpy()).all()


def test_derived_scenes_keep_the_rendering() -> None:
    scene = replace(cloud(20, degree=1), rendering=Rendering("antialiased", 0.1))
    for changed in (
        scene.subset(torch.arange(3)),
        scene.attenuated(0.5),
        scene.attenuated(1),
        scene.without_zero_bands(),
    ):
        assert changed.rendering == scene.rendering


def test_requested_rendering_overrides_mode_and_eps2d() -> None:
    mip, flat = Rendering("antialiased", 0.1), Rendering("2dgs")
    assert mip.requested("auto", None) == mip.requested("antialiased", None) == mip
    assert mip.requested("classic", None) == CLASSIC
    assert CLASSIC.requested("antialiased", None) == Rendering("antialiased", 0.3)
    assert CLASSIC.requested("auto", 0.2) == Rendering("classic", 0.2)
    assert flat.requested("classic", None) == flat
