"""Tests of the optimizer: Adam, colors in range, in a subspace, or with their own chroma."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.quality.judge import saturated
from sgsst_core.regions import Regions
from sgsst_core.scene.colors import LARGEST, gray, luminance, resize_area, style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.styles import luminance_start, prepared_style
from sgsst_core.stylizing.stylizer import ADAM_EPS, LARGEST_GRADIENT, ColorOptimizer, Stylizer
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras, style, wall

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.usefixtures("one_thread"), *([pytest.mark.gpu] if DEVICE == "cuda" else [])]
STEPS = 6


def gradients() -> list[Tensor]:
    """Return gradients of very different magnitudes, including zeros as for Gaussians outside of a view."""
    generator = torch.Generator().manual_seed(1)
    sizes = 10.0 ** torch.linspace(-18, 18, 90)[:, None]
    drawn = [torch.randn((90, 3), generator=generator) * sizes for _ in range(STEPS)]
    return [(gradient * (torch.rand((90, 1), generator=generator) > 0.3)).to(DEVICE) for gradient in drawn]


def rate(step: int) -> float:
    return float(0.3 * 0.7**step)


def test_steps_are_bit_identical_to_pytorchs_adam() -> None:
    start = torch.randn((90, 3), generator=torch.Generator().manual_seed(2)).to(DEVICE)
    colors, theirs = start.clone(), start.clone().requires_grad_()
    optimizer = ColorOptimizer(colors)
    adam = torch.optim.Adam([theirs], lr=1.0, eps=ADAM_EPS, fused=DEVICE == "cuda")
    for step, gradient in enumerate(gradients()):
        adam.param_groups[0]["lr"] = rate(step)
        theirs.grad = gradient
        adam.step()
        optimizer.update(gradient, rate(step))
        assert torch.equal(colors.detach(), theirs.detach()), step
    first, second = optimizer.moments()
    assert torch.equal(first, adam.state[theirs]["exp_avg"].cpu())
    assert torch.equal(second, adam.state[theirs]["exp_avg_sq"].cpu())


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


def test_luminance_mode_stays_in_the_range_of_screens_if_the_chroma_fits(tiny_weights: BackboneWeights) -> None:
    scene = wall(60, 40)
    stylizer = make(tiny_weights, scene, bounded=True, preserve_colors="luminance")
    run(stylizer)
    stylized = stylizer.stylized()
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


def test_rejected_step_clamps_no_colors() -> None:
    colors = torch.full((4, 3), 5.0)
    ColorOptimizer(colors, bounded=True).update(torch.full((4, 3), 10 * LARGEST_GRADIENT), 0.1)
    assert bool((colors == 5).all())


#: Rounding error of a value around 1 that is rounded to float32 for the second time.
ROUNDING = 2**-22


def chroma_off(stylized: torch.Tensor, scene: Scene) -> float:
    """Return the largest difference between the changes of two color channels of a Gaussian."""
    change = stylized.double() - scene.sh_dc.double()
    size = torch.maximum(stylized.abs(), scene.sh_dc.abs()).amax(1, keepdim=True).clamp_min(1).double()
    return float(((change - change.mean(1, keepdim=True)).abs() / size).max())


@pytest.mark.parametrize(
    ("make_scene", "values"),
    [
        (wall, {"clamp_aware_gradient": False}),
        (ball, {"warm_start": True, "training_background": "palette"}),
        (wall, {"style_loss": "mixed", "memory_limit": 1 << 20}),
        (wall, {"content_weight": 0, "views_per_step": 2}),
        (ball, {"unseen": "freeze"}),
    ],
)
def test_every_gaussian_keeps_its_chroma(
    tiny_weights: BackboneWeights, make_scene: Any, values: dict[str, Any]
) -> None:
    scene = make_scene()
    stylizer = make(tiny_weights, scene, steps_sos=4, learning_rate=0.2, preserve_colors="luminance", **values)
    assert any(line.item == "colors" for line in stylizer.job.plan.decisions)
    before = stylizer.sh_dc.detach().clone()
    run(stylizer)
    stylized = stylizer.stylized()
    assert float((stylizer.sh_dc.detach() - before).abs().max()) > 0.1
    assert chroma_off(stylized, scene) < ROUNDING
    if values.get("unseen") != "freeze" and not stylizer.job.plan.seen.all():
        hidden = ~stylizer.job.plan.seen
        assert float((stylized - scene.sh_dc)[hidden].abs().max()) > 0


def test_gradient_is_the_derivative_by_luminance(tiny_weights: BackboneWeights) -> None:
    """The derivative is with respect to a value added to all channels of a Gaussian, by autograd from definitions."""
    scene, view = wall(), cameras(1)[0]
    settings = make_settings(preserve_colors="luminance", coarsest_side=24, steps_coarse=0, clamp_aware_gradient=False)
    stylizer = Stylizer.planned(scene, [view], style(), settings, weights=tiny_weights)
    actual, _ = stylizer.gradient(0, stylizer.job.scales(0))

    rasterizer = ReferenceRasterizer(scene)
    colors = (COLOR_OFFSET + SH_C0 * scene.sh_dc.double()).clamp_min(0)
    image = rasterizer.render(colors, view)
    size = (view.height, view.width)
    (painting,) = stylizer.job.styles.own.images
    used = resize_area(painting, style_size((painting.shape[0], painting.shape[1]), size))
    _, pixels = sos_reference(stylizer.job.weights, image, used, image, coarsest=24)
    exact = rasterizer.color_gradient(pixels, view) * SH_C0 * (colors > 0)
    assert stylizer.job.weights.gray
    assert relative_error(actual.sum(1).double(), exact.sum(1)[stylizer.job.plan.seen]) < 1e-4


def test_style_gets_the_luminance_of_the_scene() -> None:
    generator = torch.Generator().manual_seed(1)
    colors = 0.4 + 0.05 * torch.randn(5000, 3, generator=generator)
    weights = torch.rand(5000, generator=generator, dtype=torch.float64)
    settings = make_settings(preserve_colors="luminance")
    painting = Style.of(0.5 + 0.1 * synthetic_image(64, 64, seed=2).float())
    (image,) = prepared_style(painting, settings, (colors - 0.5) / SH_C0, weights).images
    assert torch.equal(image[..., 0], image[..., 1])
    share, values = weights / weights.sum(), luminance(colors.double())
    mean = float((share * values).sum())
    assert float(image.double().mean()) == pytest.approx(mean, abs=1e-5)
    assert float(image[..., 0].double().std(correction=0)) == pytest.approx(
        float((share * (values - mean).square()).sum().sqrt()), rel=1e-3
    )


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_flat_styles_and_scenes_are_finite(value: float) -> None:
    settings = make_settings(preserve_colors="luminance")
    flat, some = torch.full((5, 4, 3), value), 0.3 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    ones = torch.ones(20, dtype=torch.float64)
    for scene_colors, painting in ((some, flat), (torch.full((20, 3), (value - 0.5) / SH_C0), style())):
        (image,) = prepared_style(Style.of(painting), settings, scene_colors, ones).images
        assert bool(image.isfinite().all())
        wanted = luminance((0.5 + SH_C0 * scene_colors).clamp(0, 1)).mean()
        torch.testing.assert_close(image.mean(), wanted, atol=1e-4, rtol=0)
        start = luminance_start(scene_colors, ones, Style.of(painting))
        assert chroma_off(start, replace(wall(), sh_dc=scene_colors)) < ROUNDING
        brightness = luminance(0.5 + SH_C0 * start.double())
        assert -1e-6 <= float(brightness.min()) <= float(brightness.max()) <= 1 + 1e-6
