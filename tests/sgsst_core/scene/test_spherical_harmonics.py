"""Tests of spherical harmonics: the basis functions, the clamp and its gradient, and scenes far from the origin."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sgsst_core.constants import SH_C0
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
    view_directions,
)
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.splat_scenes import camera, cloud, rotated_pose


def sphere(polar: int = 64, around: int = 128) -> tuple[Tensor, Tensor]:
    """Return directions and weights of a quadrature on the sphere that is exact for products of basis functions."""
    step = 2 * math.pi / around
    x, w = torch.from_numpy(_gauss(polar)[0]), torch.from_numpy(_gauss(polar)[1])
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


def _gauss(count: int) -> tuple:
    import numpy as np

    return np.polynomial.legendre.leggauss(count)


def test_basis_is_orthonormal() -> None:
    directions, weights = sphere()
    values = torch.cat([torch.full((len(directions), 1), SH_C0, dtype=torch.float64), basis(directions, 3)], dim=1)
    products = values.T @ (weights[:, None] * values)
    assert torch.allclose(products, torch.eye(16, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("chunk", [7, 1 << 17])
def test_harmonics_energy_is_that_over_all_directions(degree: int, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spherical_harmonics, "_CHUNK", chunk)
    scene = cloud(20, degree=degree)
    weights = torch.rand(20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights[:3] = 0
    directions, quadrature = sphere()
    colors = SH_C0 * scene.sh_dc.double() - (weights @ (SH_C0 * scene.sh_dc.double())) / weights.sum()
    rest = basis(directions, degree) @ held(scene.sh_rest).double().permute(1, 0, 2).reshape(-1, 60)
    squares = (quadrature @ rest.square() / (4 * math.pi)).reshape(20, 3).sum(dim=1)
    energy, variance = weights @ squares, weights @ colors.square().sum(dim=1)
    assert harmonics_energy(scene, weights) == pytest.approx(float(energy / (energy + variance)), rel=1e-9)


def test_harmonics_energy_has_no_division_by_zero() -> None:
    scene, weights = cloud(5, degree=1), torch.ones(5, dtype=torch.float64)
    same = replace(scene, sh_dc=torch.full_like(scene.sh_dc, 0.5))
    assert harmonics_energy(same, weights) == 1
    assert harmonics_energy(replace(same, sh_rest=torch.zeros_like(held(same.sh_rest))), weights) == 0
    huge = replace(scene, sh_rest=torch.full_like(held(scene.sh_rest), 1e30))
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


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rest_colors_are_sums_over_the_basis(degree: int) -> None:
    scene, view = cloud(50, degree=3), camera(pose=rotated_pose())
    count = (degree + 1) ** 2 - 1
    alone = rest_colors(held(scene.sh_rest)[:, :count], scene.means, view)
    values = basis(view_directions(scene.means, view.center), degree)
    expected = (values[:, :, None] * held(scene.sh_rest)[:, :count].double()).sum(1)
    assert alone.dtype == torch.float32
    assert torch.allclose(alone.double(), expected, atol=1e-6)
    assert degree > 0 or not alone.any()


def far_from_the_origin() -> tuple[Scene, Camera]:
    scene, view = cloud(300, degree=3), camera(pose=rotated_pose())
    offset = torch.tensor([1e6, -2e6, 1.5e6], dtype=torch.float64)
    pose = view.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ offset
    return replace(scene, means=(scene.means.double() + offset).float()), replace(view, world_to_camera=pose)


def at_the_center() -> tuple[Scene, Camera]:
    """Return Gaussians at the camera's center, and at distances whose squares underflow or overflow."""
    scene = cloud(5, degree=3)
    means = torch.tensor([[0.0, 0, 0], [1e-38, 0, 0], [1e38, 1e38, 0], [0, 1e-45, -1e-45], [0, 0, -2.0]])
    return replace(scene, means=means), camera()


def huge_coefficients() -> tuple[Scene, Camera]:
    """Return Gaussians with huge SH coefficients, some of which cancel each other."""
    scene = cloud(300, degree=3)
    sizes = torch.logspace(0, 36, 300)[:, None, None]
    return replace(scene, sh_rest=held(scene.sh_rest) * sizes), camera(pose=rotated_pose())


KERNEL_CASES: dict[str, Callable[[], tuple[Scene, Camera]]] = {
    "ordinary": lambda: (cloud(300, degree=3), camera(pose=rotated_pose())),
    "camera far from the origin": far_from_the_origin,
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
    whole = held(scene.sh_rest)
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
    whole = held(scene.sh_rest)
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
    sh_rest, means = held(scene.sh_rest).cuda(), scene.means.cuda()
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
    with pytest.raises(ValueError, match="degree 4"):
        basis(torch.zeros(1, 3), 4)
