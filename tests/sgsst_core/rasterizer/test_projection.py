"""Tests of the projection and of tile intersections."""

import math
from dataclasses import replace
from enum import IntEnum
from fractions import Fraction

import numpy as np
import pytest
import torch

from sgsst_core.constants import EPS2D
from sgsst_core.rasterizer.cpu import (
    CpuRasterizer,
    project,
)
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import Rendering
from tests.sgsst_core.rasterizer.splat_reference import splat
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose, single, together

_HALF_LOG2_E = 0.5 * math.log2(math.e)


class Column(IntEnum):
    """Columns of `Projection.values`."""

    X = 0
    Y = 1
    SKEW = 2
    U_SCALE = 3
    W_SCALE = 4
    LOG2_OPACITY = 5
    EXTENT_X = 6
    EXTENT_Y = 7


def test_projection_agrees_with_plain_pytorch() -> None:
    scene, view = cloud(3000, log_scale=-2.0), camera(pose=rotated_pose())
    fast, plain = project(scene, view), splat(scene, view)
    place = {int(g): i for i, g in enumerate(plain.gaussians)}
    assert set(fast.gaussians.tolist()) <= set(place), "the reference keeps what is off the image, never less"
    rows = torch.tensor([place[int(g)] for g in fast.gaussians])
    assert bool((rows.diff() > 0).all()), "both are in order of depth"
    values = torch.from_numpy(fast.values)
    p, det = plain.w_scale[rows].pow(-2), plain.w_scale[rows].pow(-2) / plain.u_scale[rows].square()
    q = plain.skew[rows] * p
    r = (det + q * q) / p
    for column, expected in (
        (Column.X, plain.x[rows]),
        (Column.Y, plain.y[rows]),
        (Column.SKEW, q / r),
        (Column.U_SCALE, (_HALF_LOG2_E * r / det).sqrt()),
        (Column.W_SCALE, (_HALF_LOG2_E / r).sqrt()),
        (Column.LOG2_OPACITY, plain.opacity[rows].log2()),
        (Column.EXTENT_X, plain.extent_x[rows]),
        (Column.EXTENT_Y, plain.extent_y[rows]),
    ):
        assert torch.allclose(values[:, column], expected, rtol=1e-9, atol=1e-9), column.name
    assert 0 < len(fast.gaussians) < len(scene)


def slanted_needle(length: float) -> tuple[Scene, Camera, Fraction, Fraction, Fraction]:
    """Return a Gaussian a million times longer than wide, its view, and its exact covariance: variances and between."""
    view, width = camera(focal=64.0), length * 1e-6
    scene = single((0.0, 0.0, 4.0), scales=(length, width, width), quat=(math.cos(0.3), 0, 0, math.sqrt(0.5)))
    w, _, _, z = (Fraction(float(v)) for v in scene.quats[0])
    n2 = w * w + z * z
    cos, sin = (w * w - z * z) / n2, 2 * w * z / n2
    s = [Fraction(float(v)) for v in scene.scales[0].double().exp()]
    fx, fy = Fraction(view.fx) / 4, Fraction(view.fy) / 4
    m0, m1 = (fx * cos * s[0], -fx * sin * s[1]), (fy * sin * s[0], fy * cos * s[1])
    return scene, view, m0[0] ** 2 + m0[1] ** 2, m0[0] * m1[0] + m0[1] * m1[1], m1[0] ** 2 + m1[1] ** 2


@pytest.mark.parametrize("length", [1.0, 1e3, 1e6])
def test_needles_have_their_exact_width(length: float) -> None:
    scene, view, p, q, r = slanted_needle(length)
    row = project(scene, view).values[0]
    assert np.isfinite(row).all()
    p, r = p + Fraction(EPS2D), r + Fraction(EPS2D)
    det = p * r - q * q
    # The tolerance is 1e-7, because projection and test compute float64 exponentials of float32 logarithms.
    assert row[Column.SKEW] == pytest.approx(float(q / r), rel=1e-12)
    assert row[Column.U_SCALE] ** 2 == pytest.approx(_HALF_LOG2_E * float(r / det), rel=1e-9)
    assert row[Column.W_SCALE] ** 2 == pytest.approx(_HALF_LOG2_E / float(r), rel=1e-12)


@pytest.mark.parametrize("length", [1.0, 1e3, 1e6])
def test_compensation_matches_exact_arithmetic(length: float) -> None:
    """The plain formula p r - q^2 would have no correct digit for a needle."""
    scene, view, p, q, r = slanted_needle(length)
    scene, eps = replace(scene, opacities=torch.tensor([20.0]), rendering=Rendering("antialiased", 0.1)), Fraction(0.1)
    expected = math.sqrt(float((p * r - q * q) / ((p + eps) * (r + eps) - q * q)))
    opacity = float(scene.opacities.double().sigmoid()) * expected
    if opacity < 1 / 255:
        assert not len(project(scene, view).gaussians)
        return
    assert 2 ** project(scene, view).values[0][Column.LOG2_OPACITY] == pytest.approx(opacity, rel=1e-9)
    assert float(splat(scene, view).opacity[0]) == pytest.approx(opacity, rel=1e-9)


def test_near_plane_must_be_positive() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        CpuRasterizer(cloud(3), near=0.0)


def test_gaussians_without_a_projection_are_dropped() -> None:
    scene = together([((0, 0, 4), 0.5, (0.1,) * 3, (1, 0, 0, 0))] * 4)
    scene.quats[1] = 0
    scene.quats[2] = 1e-30  # short, but still a direction
    scene.scales[3] = 500  # e^500 squared overflows
    projection = project(scene, camera())
    assert projection.gaussians.tolist() == [0, 2]
    assert splat(scene, camera()).gaussians.tolist() == [0, 2]
