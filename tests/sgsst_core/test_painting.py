"""Tests of painted views: the solver against dense float64 least squares, and what spreads to the other Gaussians."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sgsst_core import painting
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import CameraError
from sgsst_core.orbit import orbit
from sgsst_core.painting import PaintedColors, PaintedView, Spreading, paint
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, scene_colors
from tests.small_scenes import wall


@pytest.fixture
def scene() -> Scene:
    """Return the wall with mid-range colors, so that nothing is clamped."""
    base, generator = wall(sh_degree=1), torch.Generator().manual_seed(2)
    dc, rest = (torch.rand(len(base), *size, generator=generator) for size in ((3,), (3, 3)))
    return replace(base, sh_dc=0.3 * dc, sh_rest=0.04 * rest - 0.02)


def cameras_of(scene: Scene) -> list[Camera]:
    return orbit(scene, 6, width=40, height=30)


def full(camera: Camera, image: Tensor) -> PaintedView:
    return PaintedView(camera, image, torch.ones(image.shape[:2]))


def blend_weights(scene: Scene, camera: Camera) -> Tensor:
    """Return W [h w, N] in float64, a column for each Gaussian."""
    rasterizer, columns = make_rasterizer("cpu", scene), []
    for index in range(len(scene)):
        one = torch.zeros(len(scene), 3)
        one[index] = 1
        columns.append(rasterizer.render(one, camera)[:, :, 0].flatten())
    return torch.stack(columns, dim=1).double()


def test_colors_are_those_of_dense_least_squares(scene: Scene) -> None:
    scene = scene.subset(torch.arange(0, len(scene), max(len(scene) // 60, 1)))
    camera = cameras_of(scene)[0]
    image = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(5)) * 0.2 + 0.4
    problem = PaintedColors(scene, [full(camera, image)], make_rasterizer("cpu", scene))
    solved, residual = problem.solve(problem.original, bounded=False, iterations=200)
    weights, rest = blend_weights(scene, camera), rest_colors(scene.sh_rest, scene.means, camera).double()
    ridge = painting.RELATIVE_RIDGE * weights.sum(dim=0) + painting.RIDGE
    original = COLOR_OFFSET + SH_C0 * scene.sh_dc.double()
    right = weights.T @ (image.double().flatten(0, 1) - weights @ rest) + ridge[:, None] * original
    wanted = torch.linalg.solve(weights.T @ weights + ridge.diag(), right)
    assert torch.allclose(solved.double(), wanted, atol=2e-4)
    assert residual < 1e-4


def test_unchanged_picture_changes_nothing(scene: Scene) -> None:
    cameras, rasterizer = cameras_of(scene), make_rasterizer("cpu", scene)
    view = full(cameras[0], rasterizer.render(scene_colors(scene, cameras[0]), cameras[0]))
    painted = paint(scene, [view], rasterizer, others=cameras)
    assert torch.allclose(painted.sh_dc, scene.sh_dc, atol=1e-4)


def test_darkness_spreads_to_gaussians_that_no_picture_shows(scene: Scene) -> None:
    cameras, count = cameras_of(scene), len(scene)
    scene = scene.subset(torch.arange(count).repeat(2))
    scene.means[count:] += 1000  # a second wall, which no camera shows
    rasterizer = make_rasterizer("cpu", scene)
    image = 0.5 * rasterizer.render(scene_colors(scene, cameras[0]), cameras[0])
    painted = paint(scene, [full(cameras[0], image)], rasterizer, others=cameras)
    assert painted.psnr_after > painted.psnr_before + 10
    unseen = rasterizer.survey(cameras[0])[1] == 0
    before, after = (COLOR_OFFSET + SH_C0 * colors[unseen].mean() for colors in (scene.sh_dc, painted.sh_dc))
    assert unseen.any()
    assert after < 0.75 * before
    assert torch.equal(paint(scene, [full(cameras[0], image)], rasterizer, others=cameras).sh_dc, painted.sh_dc)


def test_transparent_pixels_stay(scene: Scene) -> None:
    camera, rasterizer = cameras_of(scene)[0], make_rasterizer("cpu", scene)
    before = rasterizer.render(scene_colors(scene, camera), camera)
    alpha = torch.zeros(camera.height, camera.width)
    alpha[:, : camera.width // 2] = 1
    painted = paint(scene, [PaintedView(camera, torch.zeros_like(before), alpha)], rasterizer)
    after = rasterizer.render(scene_colors(replace(scene, sh_dc=painted.sh_dc), camera), camera)
    far = camera.width * 3 // 4
    assert (after - before)[:, far:].abs().mean() < 0.02
    assert after[:, : camera.width // 4].mean() < 0.5 * before[:, : camera.width // 4].mean()


def test_clamped_colors_can_rise(scene: Scene) -> None:
    black = replace(scene, sh_dc=torch.full_like(scene.sh_dc, -5.0))
    camera, rasterizer = cameras_of(scene)[0], make_rasterizer("cpu", scene)
    problem = PaintedColors(black, [full(camera, torch.full((camera.height, camera.width, 3), 0.4))], rasterizer)
    assert problem.psnr(problem.solve(problem.original)[0]) > problem.psnr(problem.original) + 3


def test_view_of_nothing_is_refused(scene: Scene) -> None:
    camera = cameras_of(scene)[0]
    away = replace(camera, world_to_camera=torch.diag(torch.tensor([-1.0, 1, -1, 1]).double()) @ camera.world_to_camera)
    with pytest.raises(CameraError, match="show nothing"):
        paint(scene, [full(away, torch.zeros(30, 40, 3))], make_rasterizer("cpu", scene))


def test_map_of_colors_reaches_everywhere() -> None:
    generator = torch.Generator().manual_seed(0)
    means, colors = torch.rand(4000, 3, generator=generator), torch.rand(4000, 3, generator=generator)
    confidence = (means[:, 0] < 0.3).float()
    change = -0.5 * colors
    spread = Spreading(means, colors, confidence)(torch.where(confidence[:, None] > 0, change, 0.0))
    assert (spread - change).abs().mean() < 0.02


def neighbors_of_gray(means: Tensor, confidence: Tensor, change: Tensor) -> Tensor:
    """Return the change of all Gaussians of one color by a plain search for the neighbors of each, in float64."""
    low, high = torch.quantile(means, torch.tensor([0.1, 0.9], dtype=torch.float64), dim=0)
    known = confidence > painting._LEAST
    mean = (confidence[known, None] * change[known]).sum(dim=0) / confidence[known].sum()
    away = torch.cdist(means, means[known]) / (high - low).norm()
    nearest, rows = away.topk(painting._NEIGHBORS, largest=False)
    votes = confidence[known][rows] * torch.exp(-0.5 * (nearest / nearest[:, painting._NEIGHBORS // 2, None]).square())
    local = (votes[:, :, None] * (change[known] - mean)[rows]).sum(dim=1) / votes.sum(dim=1, keepdim=True)
    return mean + torch.exp(-(nearest[:, painting._NEAR - 1, None] / painting._FADE).square()) * local


def test_neighbors_are_those_of_a_plain_search(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(3000, 3, generator=generator, dtype=torch.float64)
    change = torch.sin(5 * means)
    confidence = torch.rand(3000, generator=generator, dtype=torch.float64) * (means[:, 0] < 0.6)
    wanted, gray = neighbors_of_gray(means, confidence, change), torch.full_like(means, 0.5)
    monkeypatch.setattr(painting, "_MOST", 2000)  # fewer than there are Gaussians, which then share cells
    shared = Spreading(means, gray, confidence)(change)
    assert (shared - wanted).abs().mean() < 0.2 * (wanted - wanted.mean(dim=0)).abs().mean()
    monkeypatch.setattr(painting, "_MOST", 3000)
    monkeypatch.setattr(painting, "_APPROXIMATION", 0.0)
    assert (Spreading(means, gray, confidence)(change) - wanted).abs().max() < 1e-3
