"""Tests of the color transfer after the last step, which is for losses without statistics that constrain colors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sgsst_core import Settings, Stylizer, make_settings
from sgsst_core.constants import SH_C0
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.planning.plan import Plan
from sgsst_core.quality.measure import Float32Reference, Measurements
from sgsst_core.regions import Region, Regions
from sgsst_core.report.images import write_contact_sheet
from sgsst_core.scene.colors import on_screen_by_luminance
from sgsst_core.scene.gaussians import Scene
from sgsst_core.style import Style
from sgsst_core.stylizing.color_transfer import warm_start
from sgsst_core.stylizing.job import prepare_job
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.planner import plan_job
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def make(
    weights: BackboneWeights, scene: Scene | None = None, regions: Regions | None = None, **values: Any
) -> Stylizer:
    settings = settings_of(**values)
    return Stylizer.planned(scene or wall(60, 40), cameras(), style(), settings, weights=weights, regions=regions)


def settings_of(**values: Any) -> Settings:
    return make_settings(**{"style_loss": "nnfm", "steps_sos": 6, "early_stop": False, **values})


def in_bfloat16(weights: BackboneWeights) -> Stylizer:
    """Make a job in bfloat16 with a fixed plan, so that the precision does not depend on the processor."""
    scene, settings = wall(60, 40), settings_of()
    plan = plan_job(scene, cameras(), Style.of(style()), settings, weights=weights).plan
    return Stylizer(
        prepare_job(replace(plan, precision="bfloat16"), scene, cameras(), Style.of(style()), settings, weights=weights)
    )


def plan_mentions_transfer(plan: Plan) -> bool:
    return any("after the last step" in line.decision for line in plan.decisions)


def test_transfer_changes_results_but_not_optimized_colors(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights)
    run(stylizer)
    optimized = stylizer.sh_dc.detach().clone()
    rows = stylizer.job.plan.optimized
    assert rows.any()
    stylized = stylizer.stylized()
    weights = stylizer.job.plan.survey.total_blend_weights[stylizer.job.plan.seen]
    wanted = warm_start(optimized, weights, stylizer.job.style)
    assert torch.equal(stylized[rows], wanted[rows[stylizer.job.plan.seen]])
    assert float((wanted - optimized).abs().mean()) > 0.01
    assert torch.equal(stylizer.sh_dc, optimized)
    assert torch.equal(stylizer.shown(), stylized[stylizer.job.plan.seen])
    assert plan_mentions_transfer(stylizer.job.plan)


@pytest.mark.parametrize(
    "values", [{"style_loss": "sos"}, {"style_loss": "mixed"}, {"warm_start": False}, {"steps_sos": 1, "steps": 0}]
)
def test_other_results_are_the_optimized_colors(tiny_weights: BackboneWeights, values: dict[str, Any]) -> None:
    """Cases are losses with statistics, a cold start, and a job without any step."""
    steps = values.pop("steps", None)
    stylizer = make(tiny_weights, **values)
    run(stylizer, Callbacks(stop=lambda: steps == stylizer.step))
    rows = stylizer.job.plan.optimized
    assert torch.equal(stylizer.stylized()[rows], stylizer.sh_dc.detach()[rows[stylizer.job.plan.seen]])
    assert torch.equal(stylizer.shown(), stylizer.sh_dc)
    assert plan_mentions_transfer(stylizer.job.plan) == (steps == 0)


def test_resumed_job_is_bit_identical(tiny_weights: BackboneWeights) -> None:
    whole, first = make(tiny_weights), make(tiny_weights)
    run(whole)
    for _ in range(3):
        first.run_step()
        first.stylized()  # as for a preview
    again = Stylizer(
        prepare_job(
            first.job.plan, wall(60, 40), cameras(), Style.of(style()), first.job.settings, weights=tiny_weights
        )
    )
    again.load_state(first.state())
    run(again)
    assert torch.equal(again.stylized(), whole.stylized())


def test_regions_get_colors_of_their_styles_and_frozen_ones_none(tiny_weights: BackboneWeights) -> None:
    scene = wall(60, 40)
    dark, bright = (Style.of(torch.full((40, 40, 3), gray)) for gray in (0.2, 0.7))
    labels = (scene.means[:, 0] > 0.5).to(torch.uint8)
    labels[scene.means[:, 1] > 1] = 2
    regions = Regions(
        (Region("rest", style=dark), Region("right", style=bright), Region("low", freeze=True)),
        labels,
    )
    stylizer = make(tiny_weights, scene, regions)
    run(stylizer)
    stylized = stylizer.stylized()
    assert torch.equal(stylized[labels == 2].view(torch.int32), scene.sh_dc[labels == 2].view(torch.int32))
    for place, gray in enumerate((0.2, 0.7)):
        own = 0.5 + SH_C0 * stylized[(labels == place) & stylizer.job.plan.optimized]
        assert float((own - gray).abs().max()) < 1e-3


@pytest.mark.parametrize("bounded", [True, False])
def test_luminance_mode_preserves_chroma(tiny_weights: BackboneWeights, bounded: bool) -> None:
    stylizer = make(tiny_weights, preserve_colors="luminance", warm_start=True, bounded=bounded, unseen="freeze")
    run(stylizer)
    rows, before = stylizer.job.plan.optimized, stylizer.job.scene.sh_dc
    stylized = stylizer.stylized()
    change = (stylized - before)[rows].double()
    assert float((change - change.mean(dim=1, keepdim=True)).abs().max()) < 1e-6
    assert not torch.equal(stylized[rows], stylizer.sh_dc.detach()[rows[stylizer.job.plan.seen]])
    off = float((on_screen_by_luminance(stylized[rows]) - stylized[rows]).abs().max())
    assert off < 1e-6 if bounded else off > 0.1


def test_reports_describe_the_written_colors(tiny_weights: BackboneWeights, tmp_path: Path) -> None:
    """Loss and images belong to the colors in the file; the error of bfloat16 compares gradients at the same colors."""
    stylizer = in_bfloat16(tiny_weights)
    run(stylizer)
    measure = Measurements(stylizer)
    written = Float32Reference(stylizer).evaluate(stylizer.job.evaluation_views, stylizer.stylized())
    assert measure.approximated
    assert measure.evaluate()[0].total == pytest.approx(written[0].total, rel=1e-6)
    assert Float32Reference(stylizer).gradient_error().relative_error < 0.5

    exact = make(tiny_weights)
    run(exact)
    after = Measurements(exact).evaluate()[0].total
    optimized = exact.evaluate(exact.job.evaluation_views)[0].total
    with exact.with_colors(exact.stylized()):
        assert exact.evaluate(exact.job.evaluation_views)[0].total == after != optimized
    other = make(tiny_weights, warm_start=False)
    sheets = []
    for colors in (exact.stylized(), exact.job.scene.sh_dc.index_put((exact.job.plan.seen,), exact.sh_dc.detach())):
        other.set_colors(colors)
        write_contact_sheet(tmp_path / "other.jpg", other)
        sheets.append((tmp_path / "other.jpg").read_bytes())
    write_contact_sheet(tmp_path / "sheet.jpg", exact)
    assert (tmp_path / "sheet.jpg").read_bytes() == sheets[0] != sheets[1]
