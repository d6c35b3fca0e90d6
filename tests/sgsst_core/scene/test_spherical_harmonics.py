"""Tests of spherical harmonics: the basis, the clamp and its gradient, and bands that are left out."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from sgsst_core.constants import SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.scene_file import read_scene, write_scene, write_stylized
from sgsst_core.scene import spherical_harmonics
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import (
    basis,
    harmonics_energy,
    kernel_rest_colors,
    reference_rest_colors,
    rest_colors,
    view_colors,
    view_colors_gradient,
)
from tests.sgsst_core.splat_scenes import camera, cloud, displaced, rotated_pose


def sphere(polar: int = 64, around: int = 128) -> tuple[Tensor, Tensor]:
    """Return directions and weights of a quadrature on the sphere that is exact for products of basis functions."""
    step = 2 * math.pi / around
    x, w = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(polar))
    angle = torch.arange(around, dtype=torch.float64) * step
    ring = (1 - x * x).sqrt()
    directions = torch.stack(
        [
            (ring[:, None] * angle.cos()).flatten(),
            (ring[:, None] * angle.sin()).flatten(),
            x[:, None].expand(-1, around).flatten(),
        ],
        dim=-1,
    )
    return directions, (w[:, None] * step).expand(-1, around).flatten()


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("chunk", [7, 1 << 17])
def test_harmonics_energy_is_that_over_all_directions(degree: int, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spherical_harmonics, "_CHUNK", chunk)
    scene = cloud(20, degree=degree)
    weights = torch.rand(20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights[:3] = 0
    directions, quadrature = sphere()
    colors = SH_C0 * scene.sh_dc.double() - (weights @ (SH_C0 * scene.sh_dc.double())) / weights.sum()
    rest = basis(directions, degree) @ scene.sh_rest.double().permute(1, 0, 2).reshape(-1, 60)
    squares = (quadrature @ rest.square() / (4 * math.pi)).reshape(20, 3).sum(dim=1)
    energy, variance = weights @ squares, weights @ colors.square().sum(dim=1)
    assert harmonics_energy(scene, weights) == pytest.approx(float(energy / (energy + variance)), rel=1e-9)


def test_harmonics_energy_has_no_division_by_zero() -> None:
    scene, weights = cloud(5, degree=1), torch.ones(5, dtype=torch.float64)
    same = replace(scene, sh_dc=torch.full_like(scene.sh_dc, 0.5))
    assert harmonics_energy(same, weights) == 1
    assert harmonics_energy(replace(same, sh_rest=torch.zeros_like(same.sh_rest)), weights) == 0
    huge = replace(scene, sh_rest=torch.full_like(scene.sh_rest, 1e30))
    assert harmonics_energy(huge, weights) == 1


def test_basis_has_signs_and_order_of_3dgs_files() -> None:
    # Computed by hand at (x, y, z) = (2, 3, 6) / 7 with the tabulated constants of the real harmonics.
    x, y, z = 2 / 7, 3 / 7, 6 / 7
    expected = [
        -0.48860251190292 * y,
        0.48860251190292 * z,
        -0.48860251190292 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    actual = basis(torch.tensor([x, y, z], dtype=torch.float64), 3)
    assert torch.allclose(actual, torch.tensor(expected, dtype=torch.float64), atol=1e-14)


def at_the_center() -> tuple[Scene, Camera]:
    """Return Gaussians at the camera's center, and at distances whose squares underflow or overflow."""
    scene = cloud(5, degree=3)
    means = torch.tensor([[0.0, 0, 0], [1e-38, 0, 0], [1e38, 1e38, 0], [0, 1e-45, -1e-45], [0, 0, -2.0]])
    return replace(scene, means=means), camera()


def huge_coefficients() -> tuple[Scene, Camera]:
    """Return Gaussians with huge SH coefficients, some of which cancel each other."""
    scene = cloud(300, degree=3)
    sizes = torch.logspace(0, 36, 300)[:, None, None]
    return replace(scene, sh_rest=scene.sh_rest * sizes), camera(pose=rotated_pose())


KERNEL_CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    "ordinary": lambda: (cloud(300, degree=3), camera(pose=rotated_pose())),
    "camera far from the origin": lambda: displaced(
        cloud(300, degree=3), camera(pose=rotated_pose()), torch.tensor([1e6, -2e6, 1.5e6])
    ),
    "a Gaussian at the center": at_the_center,
    "huge coefficients": huge_coefficients,
    "no Gaussian": lambda: (cloud(0, degree=3), camera()),
}


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("name", KERNEL_CASES)
def test_kernel_agrees_with_float64_reference(name: str, degree: int) -> None:
    """Files have this degree, or higher bands that are not used."""
    pytest.importorskip("triton")
    scene, view = KERNEL_CASES[name]()
    whole = scene.sh_rest
    device = "cuda" if torch.cuda.is_available() else "cpu"
    count = (degree + 1) ** 2 - 1
    exact = reference_rest_colors(whole.double(), scene.means, view, degree)
    sizes = whole[:, :count].abs().double().sum(1)
    for sh_rest in (whole, whole[:, :count]):
        actual = kernel_rest_colors(sh_rest.to(device), scene.means.to(device), view, degree)
        assert actual.dtype == torch.float32
        assert bool(((actual.cpu().double() - exact).abs() <= 1e-6 * sizes).all())


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("name", KERNEL_CASES)
def test_cpu_sums_are_float64_rounded_once(name: str, degree: int) -> None:
    scene, view = KERNEL_CASES[name]()
    whole = scene.sh_rest
    count = (degree + 1) ** 2 - 1
    exact = reference_rest_colors(whole.double(), scene.means, view, degree)
    sizes = whole[:, :count].abs().double().sum(1)
    actual = rest_colors(whole[:, :count], scene.means, view)
    assert actual.dtype == torch.float32
    assert bool(((actual.double() - exact).abs() <= 2**-24 * exact.abs() + 1e-14 * sizes).all())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU that PyTorch can use")
def test_gpu_colors_come_from_the_kernel() -> None:
    scene, view = cloud(300, degree=3), camera(pose=rotated_pose())
    sh_rest, means = scene.sh_rest.cuda(), scene.means.cuda()
    colors_on_gpu = rest_colors(sh_rest, means, view)
    assert torch.equal(colors_on_gpu, kernel_rest_colors(sh_rest, means, view, 3))
    assert torch.allclose(colors_on_gpu.cpu(), rest_colors(scene.sh_rest, scene.means, view), atol=1e-5)


def test_colors_are_clamped_and_gradient_is_zero_below_the_clamp() -> None:
    generator = torch.Generator().manual_seed(0)
    sh_dc = 3 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    rest = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    sh_dc.requires_grad_()
    colors = view_colors(sh_dc, rest)
    assert float(colors.detach().min()) == 0
    assert float(colors.detach().max()) > 1
    assert torch.autograd.gradcheck(lambda dc: view_colors(dc, rest), (sh_dc,))
    gradient = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    (expected,) = torch.autograd.grad(colors, sh_dc, gradient)
    assert torch.allclose(view_colors_gradient(gradient, colors.detach()), expected, atol=1e-15)


def test_clamp_aware_gradient_only_raises_clamped_colors() -> None:
    """At a color clamped to 0, a gradient passes if it would raise the color, not if it would lower it."""
    colors = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.2, 0.0]])
    gradient = torch.tensor([[-1.0, 1.0, 2.0], [0.0, -3.0, -4.0]])
    result = view_colors_gradient(gradient, colors, clamp_aware_gradient=True)
    torch.testing.assert_close(result, SH_C0 * torch.tensor([[-1.0, 0.0, 2.0], [0.0, -3.0, -4.0]]))


def test_wrong_number_of_coefficients_is_refused() -> None:
    scene, view = cloud(5, degree=1), camera()
    with pytest.raises(ValueError, match="coefficients per Gaussian, not 4"):
        rest_colors(torch.zeros(5, 4, 3), scene.means, view)


@pytest.mark.parametrize(("last", "degree"), [(None, 0), (0, 1), (2, 1), (3, 2), (7, 2), (8, 3)])
def test_zero_bands_are_removed(last: int | None, degree: int) -> None:
    values = torch.zeros(100, 15, 3)
    if last is not None:
        values[61, last, 2] = -1e-30
    scene = replace(cloud(100, degree=3), sh_rest=values)
    less = scene.without_zero_bands()
    assert (scene.used_degree(), less.sh_degree) == (degree, degree)
    assert torch.equal(less.sh_rest, values[:, : (degree + 1) ** 2 - 1])
    without = torch.ones(100, dtype=torch.bool)
    without[61] = False
    assert scene.used_degree(without) == 0


def test_invalid_gaussians_are_dropped_and_counted(tmp_path: Path) -> None:
    scene = cloud(100, degree=2)
    values = scene.sh_rest.clone()
    values[3, 1, 2], values[70, 0, 0] = torch.nan, torch.inf  # f_rest_17 and f_rest_0
    scene.opacities[70] = torch.nan
    write_scene(tmp_path / "scene.ply", replace(scene, sh_rest=values))
    with pytest.raises(SceneError) as caught:
        read_scene(tmp_path / "scene.ply")
    assert "2 of 100" in str(caught.value)
    assert "opacity, f_rest_0, f_rest_17" in str(caught.value)
    source = read_scene(tmp_path / "scene.ply", drop_invalid=True)
    assert len(source.scene) == 98
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc + 1)
    again = read_scene(tmp_path / "out.ply").scene
    assert torch.equal(again.sh_rest, source.scene.sh_rest)
    assert torch.equal(again.sh_dc, source.scene.sh_dc + 1)
