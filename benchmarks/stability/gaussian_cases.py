"""Hard cases of extreme Gaussians, mixed with ordinary Gaussians whose pixels must stay correct."""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.stability.case import (
    Case,
    CaseResult,
    among_ordinary,
    camera,
    compare_rasterizers,
    ordinary,
    repeated,
    without,
)
from sgsst_core.constants import ALPHA_MIN, NEAR, SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.cpu import project
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors, view_directions
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer

_IMAGE = "image, coverage, gradient against float64"
_PROPERTIES = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest")


def cases() -> list[Case]:
    """Return all cases of this group."""
    entries = [
        Case(f"{value} in {name}, in the file", "Gaussians", _IMAGE, partial(_invalid_in_file, name, value))
        for name in _PROPERTIES
        for value in ("nan", "inf", "-inf")
    ]
    entries += [
        Case(f"{value} in {name}, in memory", "Gaussians", _IMAGE, partial(_invalid_in_memory, name, value))
        for name, value in [
            ("means", "nan"),
            ("means", "inf"),
            ("quats", "nan"),
            ("scales", "inf"),
            ("opacities", "nan"),
        ]
    ]
    entries += [Case(name, "Gaussians", _IMAGE, partial(_rendered, make)) for name, make in _SCENES.items()]
    return [
        *entries,
        Case("needles, 1e6 times longer than wide, at every angle", "Gaussians", _IMAGE, _needles),
        Case("near plane, one ulp before, on and behind it", "Gaussians", _IMAGE, _near_plane),
        Case("equal depths blend in the order of the file", "Gaussians", "rows out of order", _equal_depths),
        Case("world moved by 1e6", "Gaussians", "image against the same world at the origin", _moved_world),
        Case("SH coefficients of 1e4 that cancel", "Gaussians", "colors, share of the largest", _large_harmonics),
        Case("view direction of length 0", "Gaussians", "colors", _no_direction),
    ]


def _rendered(make: Callable[[], Scene], full: bool) -> CaseResult:
    return compare_rasterizers(among_ordinary(make()), camera())


def _quaternions() -> Scene:
    """Return Gaussians with quaternions of length 0 (never drawn), denormal, tiny and huge lengths."""
    lengths = torch.tensor([0.0, 1e-45, 1e-30, 1e-4, 1.0, 1e4, 1e19, 1.9e38])
    return replace(repeated(8), quats=torch.tensor([0.5, 0.5, -0.5, 0.7]) * lengths[:, None])


def _scales() -> Scene:
    """Return Gaussians with scales of 0 (underflow in float64), 1e-20, 1e10, 1e30, or float64 overflow (not drawn)."""
    logarithms = torch.tensor([-3e38, -1000.0, math.log(1e-20), math.log(1e10), math.log(1e30), 300.0, 1e5, 3e38])
    return replace(repeated(8), scales=logarithms[:, None].expand(8, 3).clone(), opacities=torch.full((8,), -2.0))


def _flat_or_thin() -> Scene:
    """Return discs and needles with zero extent along their short axes."""
    none, some = -200.0, -1.0
    axes = [[none, some, some], [some, none, some], [some, some, none], [none, none, some], [some, none, none]]
    return replace(ordinary(5, seed=3), scales=torch.tensor(axes))


def _opacities_at_the_cutoff() -> Scene:
    """Return Gaussians whose opacity is 1/255, a float32 neighbor of it, or slightly larger.

    Their alpha reaches the cutoff of 1/255 at one pixel center at most.
    """
    cutoff = np.float32(math.log(ALPHA_MIN / (1 - ALPHA_MIN)))
    values = [
        np.nextafter(cutoff, np.float32(-9)),
        cutoff,
        np.nextafter(cutoff, np.float32(9)),
        cutoff + np.float32(1e-3),
    ]
    # Centered on a pixel of `camera()`, whose principal point is (19.8, 13.8): x = 4 (20.5 - 19.8) / 30.
    scene = repeated(4, mean=(4 * 0.7 / 30, 4 * 0.7 / 33, 4.0))
    return replace(scene, opacities=torch.tensor(np.array(values)))


def _logits() -> Scene:
    """Return Gaussians with opacities of almost or exactly 0 and 1, up to the largest float32 logits."""
    return replace(ordinary(8, seed=4), opacities=torch.tensor([-3e38, -1e4, -100.0, -17.0, 17.0, 100.0, 1e4, 3e38]))


def _depths() -> Scene:
    """Return Gaussians at, near and behind the camera's plane, none of them beyond the near plane."""
    scene = repeated(7, scale=0.5)
    depths = torch.tensor([0.0, -0.0, 1e-38, -1e-38, 1e-6, -1e-6, -4.0])
    return replace(scene, means=torch.stack([torch.zeros(7), torch.zeros(7), depths], dim=1))


def _off_screen() -> Scene:
    """Return Gaussians centered up to a million pixels outside the view, whose footprints reach into it."""
    means = torch.tensor([[-20.0, 0, 4], [20, 1, 4], [0, -15, 4], [0, 1e3, 4], [-1.3e5, 0, 4]])
    sizes = torch.tensor([6.0, 6.0, 5.0, 400.0, 5e4]).log()
    return replace(repeated(5, logit=-1.0), means=means, scales=sizes[:, None].expand(5, 3).clone())


def _stacked(count: int, logit: float) -> Scene:
    """Return `count` Gaussians at one point, so that the transmittance is a product of `count` factors."""
    return repeated(count, scale=0.02, logit=logit)


def _sub_pixel() -> Scene:
    """Return thousands of Gaussians much smaller than a pixel."""
    scene = ordinary(3000, seed=7)
    return replace(scene, scales=torch.full((3000, 3), math.log(1e-6)))


def _grazing() -> Scene:
    """Return Gaussians just beyond the near plane and far to the side.

    The derivatives of perspective projection are largest there.
    """
    scene = ordinary(60, seed=8)
    depths = torch.full((60,), NEAR * 1.001)
    return replace(scene, means=torch.stack([scene.means[:, 0] * 5, scene.means[:, 1] * 5, depths], dim=1))


_SCENES: dict[str, Callable[[], Scene]] = {
    "quaternions of length 0, 1e-45 to 1.9e38": _quaternions,
    "scales of 0, 1e-20, 1e10, 1e30 and beyond float64": _scales,
    "axes without any extent": _flat_or_thin,
    "opacities of 1/255 and one ulp to either side": _opacities_at_the_cutoff,
    "logits to +-3e38": _logits,
    "depth 0, +-1e-38, +-1e-6; a center at the camera": _depths,
    "centers off screen with a footprint on it": _off_screen,
    "5000 faint Gaussians on one pixel": partial(_stacked, 5000, math.log(1.5 / 253.5)),
    "5000 opaque Gaussians on one pixel": partial(_stacked, 5000, 5.0),
    "thousands of Gaussians smaller than a pixel": _sub_pixel,
    "far to the side at the near plane": _grazing,
}


def _invalid_in_file(name: str, value: str, full: bool) -> CaseResult:
    """Check that a file with an invalid value is refused, or its opacity clamped.

    With `drop_invalid`, the rest must render as if the Gaussian did not exist.
    """
    scene = ordinary(60, degree=1)
    getattr(scene, name)[7] = float(value)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        write_scene(path, scene)
        try:
            file = read_scene(path)
            if not file.clamped:
                return CaseResult(math.inf, 0.0, "the file was not refused")
            return replace(compare_rasterizers(file.scene, camera()), note="read as almost 0 or 1")
        except SceneError:
            read = read_scene(path, drop_invalid=True).scene
    rows = torch.zeros(60, dtype=torch.bool)
    rows[7] = True
    expected, _ = without(scene, rows)
    if not torch.equal(read.means, expected.means):
        return CaseResult(math.inf, 0.0, "another Gaussian was left out")
    return replace(compare_rasterizers(read, camera()), note="refused; --drop-invalid leaves it out")


def _invalid_in_memory(name: str, value: str, full: bool) -> CaseResult:
    """Check that a Gaussian whose geometry cannot be projected contributes nothing."""
    scene = ordinary(60)
    getattr(scene, name)[7] = float(value)
    rows = torch.zeros(60, dtype=torch.bool)
    rows[7] = True
    expected, others = without(scene, rows)
    return replace(
        compare_rasterizers(scene, camera(), expected_scene=expected, rows=others), note="the Gaussian is left out"
    )


def _needles(full: bool) -> CaseResult:
    """Check needles in all orientations.

    Their determinant, computed as p r - q^2 in float32, has no correct digit and is often negative.
    """
    worst, lost = CaseResult(0.0, 0.0), 0
    steps = 180 if full else 36
    for step in range(steps):
        half = math.pi * step / steps / 2
        needle = repeated(1, logit=3.0)
        needle.quats[0] = torch.tensor([math.cos(half), 0.05 * math.sin(3 * half), 0.0, math.sin(half)])
        needle.scales[0] = torch.tensor([math.log(1e3), math.log(1e-3), math.log(1e-3)])
        result = compare_rasterizers(among_ordinary(needle, count=10), camera())
        worst = result if not result.error <= worst.error else worst
        lost += _float32_determinant_is_lost(needle)
    return replace(worst, note=f"p r - q^2 in float32 is off by more than 10 % or negative in {lost} of {steps}")


def _float32_determinant_is_lost(needle: Scene) -> bool:
    """Return whether the determinant p r - q^2 of `needle`, computed in float32, has a relative error above 0.1."""
    actual = project(needle, camera()).values
    if not len(actual):
        return False
    # r, det and q follow from the stored projection: w_scale^2 = k / r, u_scale^2 = k r / det.
    k = 0.5 * math.log2(math.e)
    r = k / actual[0, 4] ** 2
    det, q = k * r / actual[0, 3] ** 2, actual[0, 2] * r
    p = (det + q * q) / r
    single = np.float32(p) * np.float32(r) - np.float32(q) * np.float32(q)
    return not abs(float(single) - det) <= 0.1 * det


def _near_plane(full: bool) -> CaseResult:
    """Check that a Gaussian on the near plane is drawn, and one that is one ulp closer is not."""
    at = np.float32(0.5)
    below, above = np.nextafter(at, np.float32(0)), np.nextafter(at, np.float32(1))
    scene = repeated(3, scale=0.05)
    scene.means[:, 2] = torch.tensor(np.array([below, at, above]))
    scene.means[:, 0] = torch.tensor([-0.1, 0.0, 0.1])
    result = compare_rasterizers(scene, camera(), near=0.5)
    if project(scene, camera(), near=0.5).gaussians.tolist() != [1, 2]:
        return CaseResult(math.inf, 0.0, "the plane itself is not where it should be")
    return replace(result, note="on the plane is drawn, one ulp nearer is not")


def _equal_depths(full: bool) -> CaseResult:
    scene = repeated(2000, scale=0.3, logit=-3.0)
    scene.means[:, 0] = torch.linspace(-1, 1, 2000)
    order = project(scene, camera()).gaussians
    wrong = int((np.diff(order) <= 0).sum()) + (len(scene) - len(order))
    result = compare_rasterizers(scene, camera())
    return CaseResult(
        float(wrong) if result.passed else math.inf, 0.0, "float32 and float64 sort the same float64 depths"
    )


def _moved_world(full: bool) -> CaseResult:
    """Check that a scene renders the same if it is translated by 1e6 along each axis.

    Positions are multiples of 1/16, which float32 represents exactly at this distance.
    """
    scene, view = ordinary(300, seed=9), camera()
    scene = replace(scene, means=(scene.means * 16).round() / 16)
    offset = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    pose = view.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ offset
    moved = replace(scene, means=scene.means + offset.float())
    colors = 2 * torch.rand(300, 3, generator=torch.Generator().manual_seed(1))
    image = ReferenceRasterizer(scene).render(colors, view)
    rendered = make_rasterizer("cpu", moved).render(colors, replace(view, world_to_camera=pose)).double()
    error = float((rendered - image).abs().max()) / 2
    return CaseResult(error, 1e-4, "float32 positions step by 0.06 there; nothing is lost beyond that")


def _large_harmonics(full: bool) -> CaseResult:
    """Check colors in which frozen SH coefficients of 1e4 and a DC coefficient of -1e4 cancel.

    The error is relative to 1e4, because of float32's limited precision.
    """
    scene = ordinary(200, seed=10, degree=3)
    scene = replace(scene, sh_rest=scene.sh_rest * 1e4)
    view = camera()
    rest = rest_colors(scene.sh_rest, scene.means, view)
    dc = (torch.rand(200, 3, generator=torch.Generator().manual_seed(2)) - rest) / SH_C0
    actual = view_colors(dc, rest).double()
    exact = rest_colors(scene.sh_rest.double(), scene.means.double(), view)
    expected = (0.5 + SH_C0 * dc.double() + exact).clamp_min(0)
    error = float((actual - expected).abs().max() / exact.abs().max())
    image = compare_rasterizers(scene, view, colors=view_colors(scene.sh_dc, rest))
    absolute = float((actual - expected).abs().max())
    return CaseResult(max(error, 0.0 if image.passed else math.inf), 1e-6, f"colors are off by up to {absolute:.1e}")


def _no_direction(full: bool) -> CaseResult:
    """Check a Gaussian at the camera's center.

    Its view direction is the zero vector. Its SH colors must be finite, and it must not be drawn.
    """
    scene = replace(repeated(3), sh_rest=torch.ones(3, 15, 3))
    means = torch.tensor([[0.0, 0, 0], [1e-45, 0, 0], [0, 1e38, 1e38]])
    scene = replace(scene, means=means)
    directions = view_directions(means, camera().center)
    lengths = directions.norm(dim=1)
    error = float((lengths - torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64)).abs().max())
    colors = rest_colors(scene.sh_rest, means, camera())
    drawn = len(project(scene, camera()).gaussians)
    finite = bool(torch.isfinite(colors).all()) and drawn == 0
    return CaseResult(
        error if finite else math.inf, 1e-12, "the zero vector: finite colors, nearer than the near plane"
    )
