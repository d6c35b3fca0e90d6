"""Tests of whole jobs whose colors are clamped to the range of screens."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from sgsst_core.constants import SH_C0
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.quality.judge import saturated
from sgsst_core.regions import Region, Regions
from sgsst_core.scene.colors import LARGEST, ColorSubspace, gray
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import LARGEST_GRADIENT, ColorOptimizer, Stylizer
from tests.small_scenes import ball, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def make(
    weights: BackboneWeights,
    scene: Scene,
    regions: Regions | None = None,
    style_image: Tensor | None = None,
    **values: Any,
) -> Stylizer:
    chosen: dict[str, Any] = {"coarsest_side": 24, "steps_coarse": 2, "steps_sos": 8, "learning_rate": 1.0} | values
    settings = make_settings(early_stop=False, **chosen)
    image = style() if style_image is None else style_image
    return Stylizer.planned(scene, cameras(), image, settings, weights=weights, regions=regions)


def bright_wall() -> Scene:
    """Return a wall that extends beyond the views and has many colors outside of the range of screens."""
    scene = wall(60, 40, sh_degree=1)
    scene.sh_dc.mul_(2)
    return scene


@pytest.mark.parametrize(
    ("make_scene", "values"),
    [
        (bright_wall, {"clamp_aware_gradient": False}),
        (ball, {"unseen": "freeze"}),
        (ball, {"training_background": "palette", "warm_start": True}),
        (bright_wall, {"views_per_step": 2}),
    ],
)
def test_changed_colors_stay_in_the_range_of_screens(
    tiny_weights: BackboneWeights, make_scene: Any, values: dict[str, Any]
) -> None:
    scene = make_scene()
    free = make(tiny_weights, scene, bounded=False, **values)
    run(free)
    bounded = make(tiny_weights, scene, bounded=True, **values)
    run(bounded)
    stylized = bounded.stylized()
    changed = (stylized != scene.sh_dc).any(dim=1)
    assert saturated(free.stylized()) > 0.1
    assert saturated(stylized[changed]) == 0
    if values.get("unseen") != "freeze":
        assert saturated(stylized) == 0
        assert bool(changed.all())


def test_luminance_mode_preserves_chroma_within_the_bounds(tiny_weights: BackboneWeights) -> None:
    scene = wall(60, 40)
    stylizer = make(tiny_weights, scene, bounded=True, preserve_colors="luminance")
    run(stylizer)
    stylized = stylizer.stylized()
    change = (stylized - scene.sh_dc).double()
    assert float((change - change.mean(dim=1, keepdim=True)).abs().max()) < 1e-6
    fits = scene.sh_dc.amax(dim=1) - scene.sh_dc.amin(dim=1) < 2 * LARGEST * (1 - 1e-5)
    assert bool(fits.any())
    assert saturated(stylized[fits]) == 0
    assert bool((~fits).any()), "a color that no luminance brings into the bounds belongs to this test"


def few_hues(image: Tensor) -> Tensor:
    """Return an image [h, w, 3] in mixtures of brown and yellow, and their shades."""
    brown, yellow = torch.tensor([0.6, 0.5, 0.3]), torch.tensor([0.2, 0.2, 0.0])
    return 0.2 + brown * image[..., :1] + yellow * image[..., 1:2]


def distance_from(style_image: Tensor, sh_dc: Tensor, axes: int) -> float:
    """Return the largest distance of colors from the principal line or plane of an image's, in 0..1, in float64."""
    pixels = style_image.reshape(-1, 3).double()
    others = torch.linalg.svd(pixels - pixels.mean(dim=0), full_matrices=False).Vh[axes:]
    return float(((0.5 + SH_C0 * sh_dc.double() - pixels.mean(dim=0)) @ others.T).norm(dim=1).max())


@pytest.mark.parametrize(
    ("make_scene", "values"),
    [(bright_wall, {"warm_start": False}), (ball, {"style_loss": "nnfm"})],
)
@pytest.mark.parametrize(("of", "axes", "form"), [(gray, 1, "a line"), (few_hues, 2, "a plane")])
def test_colors_stay_in_the_subspace(
    tiny_weights: BackboneWeights, make_scene: Any, values: dict[str, Any], of: Any, axes: int, form: str
) -> None:
    """Seen and unseen Gaussians get colors of the style's line or plane; without bounds, the loss gives them others."""
    image = of(style())
    scene = make_scene()
    stylizer, free = (
        make(tiny_weights, scene, style_image=image, bounded=bounded, **values) for bounded in (True, False)
    )
    run(stylizer)
    run(free)
    lines, free_lines = (
        [line.decision for line in own.job.plan.decisions if line.item == "color subspace"] for own in (stylizer, free)
    )
    assert lines == [f"colors stay on {form} in RGB"]
    assert free_lines == []
    stylized = stylizer.stylized()
    inside = (stylized.abs() < LARGEST).all(dim=1)
    assert distance_from(image, stylized[inside], axes) < 1e-5
    assert saturated(stylized) == 0
    assert distance_from(image, free.stylized(), axes) > 0.02


@pytest.mark.slow
def test_several_styles_free_the_colors(tiny_weights: BackboneWeights) -> None:
    scene, image = wall(), gray(style())
    right = (scene.means[:, 0] > 0).to(torch.uint8)
    for second, stays in ((Region("right", freeze=True), True), (Region("right", style=Style.of(style())), False)):
        stylizer = make(tiny_weights, scene, Regions((Region("rest"), second), right), style_image=image, bounded=True)
        run(stylizer)
        assert (distance_from(image, stylizer.stylized()[right == 0], 1) < 1e-5) == stays


def test_frozen_gaussians_may_be_out_of_range(tiny_weights: BackboneWeights) -> None:
    scene = bright_wall()
    right = (scene.means[:, 0] > 0).to(torch.uint8)
    regions = Regions((Region("rest"), Region("right", freeze=True)), right)
    stylizer = make(tiny_weights, scene, regions, bounded=True)
    run(stylizer)
    stylized = stylizer.stylized()
    frozen = regions.frozen
    assert saturated(scene.sh_dc[frozen]) > 0.1
    assert torch.equal(stylized[frozen].view(torch.int32), scene.sh_dc[frozen].view(torch.int32))
    assert saturated(stylized[~frozen]) == 0


def adam(start: Tensor, gradients: list[Tensor], rate: float) -> Tensor:
    """Run Adam (Kingma and Ba 2015, algorithm 1) with a projection after each step, by its definition in float64."""
    colors, first, second = start.double(), torch.zeros(start.shape).double(), torch.zeros(start.shape).double()
    for step, gradient in enumerate(gradients, start=1):
        first = 0.9 * first + 0.1 * gradient.double()
        second = 0.999 * second + 0.001 * gradient.double().square()
        colors = colors - rate * (first / (1 - 0.9**step)) / ((second / (1 - 0.999**step)).sqrt() + 1e-15)
        colors = ((0.5 + SH_C0 * colors).clamp(0, 1) - 0.5) / SH_C0
    return colors


def test_steps_match_projected_adam() -> None:
    generator = torch.Generator().manual_seed(3)
    start = torch.randn((200, 3), generator=generator)
    gradients = [torch.randn((200, 3), generator=generator) + 0.5 for _ in range(20)]
    colors = start.clone()
    optimizer = ColorOptimizer(colors, bounded=True)
    for gradient in gradients:
        optimizer.update(gradient, 0.3)
    expected = adam(start, gradients, 0.3)
    assert float((expected.abs() > LARGEST - 1e-6).double().mean()) > 0.1
    torch.testing.assert_close(colors.detach().double(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("of", [gray, few_hues])
def test_steps_within_a_subspace_reach_its_nearest_color(of: Any) -> None:
    """Compare with the closed form of the minimum, for a quadratic with a large curvature in one channel."""
    subspace = ColorSubspace.of(Style.of(of(style())))
    assert subspace is not None
    colors, target = torch.zeros((50, 3)), 0.8 * torch.randn((50, 3), generator=torch.Generator().manual_seed(4))
    curvature = torch.tensor([1.0, 1.0, 20.0])
    optimizer = ColorOptimizer(colors, subspace=subspace, bounded=True)
    for step in range(600):
        optimizer.update(curvature * (colors.detach() - target), 0.1 * 0.99**step)
    axes = torch.linalg.eigh(subspace.matrix.double()).eigenvectors[:, 3 - subspace.dimensions :]
    weighted, start = axes.T * curvature.double(), subspace.offset.double()
    expected = start + (axes @ torch.linalg.solve(weighted @ axes, weighted @ (target.double() - start).T)).T
    inside = (expected.abs() < LARGEST).all(dim=1)
    assert float(inside.double().mean()) > 0.5
    torch.testing.assert_close(colors.detach().double()[inside], expected[inside], rtol=0, atol=1e-3)


def test_rejected_step_clamps_no_colors() -> None:
    colors = torch.full((4, 3), 5.0)
    ColorOptimizer(colors, bounded=True).update(torch.full((4, 3), 10 * LARGEST_GRADIENT), 0.1)
    assert bool((colors == 5).all())
