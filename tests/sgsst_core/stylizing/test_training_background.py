"""Tests of training backgrounds of object scans: seed, step and view determine them, and they affect nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import pytest
import torch

from sgsst_core.budget import Cache
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.images import Color
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.scene.colors import downscale
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.checkpoint import Checkpoint, Checkpoints, load_checkpoint, versions
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.steps import mean_loss
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.stylizing.views import drawn_color, replace_background
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import HEIGHT, WIDTH, ball, cameras, style

pytestmark = pytest.mark.usefixtures("one_thread")

COLOR: Color = (0.2, 0.9, 0.4)


def make(weights: BackboneWeights, scene: Scene, views: int = 3, **values: Any) -> Stylizer:
    settings = make_settings(**{"steps_coarse": 3, "steps_sos": 5, "coarsest_side": 24, **values})
    return Stylizer.planned(scene, cameras(views), style(), settings, weights=weights)


# --- colors -------------------------------------------------------------------------------------------------------


def test_color_depends_only_on_seed_step_and_view() -> None:
    """One color is hard-coded, because it must be the same on every machine and with every version."""
    image = Style.of(style())
    assert drawn_color("random", 5, 7, 11, image) == (0.659657205637411, 0.3164479498593752, 0.6750821160034983)
    colors = {
        numbers: drawn_color("random", *numbers, image)
        for numbers in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (2**63 - 1, 10**6, 300), (0, 11, 1), (0, 1, 11))
    }
    assert len(set(colors.values())) == len(colors)
    assert all(drawn_color("random", *numbers, image) == color for numbers, color in colors.items())
    assert drawn_color("background", 0, 0, 0, image) is None


def test_palette_colors_are_those_of_style_pixels() -> None:
    image = Style.of(torch.tensor([[[0.1, 0.2, 0.3], [0.9, 0.5, 0.0], [0.9, 0.5, 0.0]], [[1.0, 1.0, 1.0]] * 3]))
    drawn = [drawn_color("palette", 0, step, 0, image) for step in range(3000)]
    shares = {color: drawn.count(color) / len(drawn) for color in set(drawn)}
    expected = {tuple(pixel.tolist()): 1 / 6 for pixel in image.images[0].reshape(-1, 3)}
    expected |= {tuple(image.images[0][0, 1].tolist()): 2 / 6, (1.0, 1.0, 1.0): 3 / 6}
    assert shares == pytest.approx(expected, abs=0.03)


# --- images on the background --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0, 2])
def test_replaced_background_matches_a_render_with_it(scale: int) -> None:
    scene, camera, present = ball(), cameras(1)[0], (0.7, 0.0, 0.3)
    colors = torch.rand(len(scene), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    over, expected = (ReferenceRasterizer(scene, background=color).render(colors, camera) for color in (present, COLOR))
    coverage = ReferenceRasterizer(scene).coverage(camera)
    actual = replace_background(downscale(over, scale), downscale(coverage, scale), COLOR, present)
    torch.testing.assert_close(actual, downscale(expected, scale), rtol=0, atol=1e-12)
    assert replace_background(over.float(), coverage.float(), COLOR, present).dtype == torch.float32


def drawn_gradient(stylizer: Stylizer, index: int, scales: list[int], behind: Color | None) -> tuple[Any, Any]:
    target, targets = (
        stylizer.job.view_targets.target(index, scales, behind),
        stylizer.job.style_targets(stylizer.job.views.cameras[0]),
    )
    return stylizer.job.gradient(index, stylizer.sh_dc.detach(), targets, target, scales, behind)


@pytest.mark.parametrize(("scales", "content"), [([0, 1], "cached"), ([1], "uncached")])
def test_step_gradient_matches_a_job_with_its_background(
    tiny_weights: BackboneWeights, scales: list[int], content: Literal["cached", "uncached"]
) -> None:
    """The content also gets the step's background, whether or not its images are cached."""
    drawn = make(tiny_weights, ball(), training_background="random", background=(0.1, 0.1, 0.5))
    fixed = make(tiny_weights, ball(), training_background="background", background=COLOR)
    if content == "uncached":
        drawn.job.view_targets._images = Cache(0, lambda _: 1)
    with torch.no_grad():
        drawn.sh_dc += 0.3
        fixed.sh_dc.copy_(drawn.sh_dc)
    for _ in range(2):
        actual, loss = drawn_gradient(drawn, 1, scales, COLOR)
        expected, exact = drawn_gradient(fixed, 1, scales, None)
        assert loss.loss == pytest.approx(exact.loss, rel=1e-5)
        assert loss.terms[scales[-1]]["content"] == pytest.approx(exact.terms[scales[-1]]["content"], rel=1e-3)
        assert exact.terms[scales[-1]]["content"] > 0
        assert relative_error(actual, expected) < 1e-4


def test_photos_get_the_color_in_uncovered_pixels(tiny_weights: BackboneWeights) -> None:
    photo = synthetic_image(HEIGHT, WIDTH, seed=9, dtype=torch.float32)
    settings = make_settings(training_background="random", steps_sos=2)
    stylizer = Stylizer.planned(ball(), cameras(1), style(), settings, weights=tiny_weights, photos=lambda _: photo)
    coverage = stylizer.job.view_targets.coverage(0)[0][..., None]
    content = coverage * photo + (1 - coverage) * torch.tensor(COLOR)
    expected = stylizer.job.loss.targets.of_view(content, coverage[..., 0]).content[0]
    actual = stylizer.job.view_targets.target(0, [0], COLOR).content[0]
    for tile, features in expected.items():
        torch.testing.assert_close(actual[tile], features, rtol=1e-4, atol=1e-2)


def test_losses_are_measured_on_the_fixed_background(tiny_weights: BackboneWeights) -> None:
    """Losses before and after are measured on the background of the settings, whatever the steps used."""
    values: dict[str, Any] = {"background": (0.3, 0.2, 0.1), "warm_start": False}
    drawn, fixed = (
        make(tiny_weights, ball(), training_background=kind, **values) for kind in ("palette", "background")
    )
    assert drawn.start() == fixed.start()
    run(drawn)
    assert mean_loss(drawn.evaluate([0, 1])) == mean_loss(fixed.evaluate([0, 1], drawn.sh_dc.detach()))


# --- whole runs ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["palette"])
def test_repeated_and_resumed_runs_are_bit_identical(tiny_weights: BackboneWeights, tmp_path: Path, kind: str) -> None:
    whole, again, resumed, other = (
        make(tiny_weights, ball(), training_background=kind, seed=seed) for seed in (3, 3, 3, 4)
    )
    for stylizer in (whole, again, other):
        assert run(stylizer) == "finished"
    assert torch.equal(whole.sh_dc, again.sh_dc)
    assert not torch.equal(whole.sh_dc, other.sh_dc)
    stopped = make(tiny_weights, ball(), training_background=kind, seed=3)
    for _ in range(4):
        stopped.run_step()
    Checkpoints(tmp_path / "c").save(Checkpoint(stopped.state(), stopped.job.plan, 1, "run", versions()), "job")
    loaded = load_checkpoint(tmp_path / "c", "job")
    assert (loaded.plan.training_background, loaded.plan.warm_start) == (kind, True)
    resumed.load_state(loaded.state)
    run(resumed)
    assert torch.equal(whole.sh_dc, resumed.sh_dc)
    losses = [[record.loss for record in stylizer.history] for stylizer in (whole, resumed)]
    assert losses[0] == losses[1]


def test_paper_preset_uses_a_fixed_background_for_scans(tiny_weights: BackboneWeights) -> None:
    settings = make_settings("paper", steps_coarse=1, steps_sos=1)
    stylizer = Stylizer.planned(ball(), cameras(2), style(), settings, weights=tiny_weights)
    assert (stylizer.job.plan.training_background, stylizer.job.plan.warm_start) == ("background", False)
    assert torch.equal(stylizer.sh_dc, ball().sh_dc[stylizer.job.plan.seen])
