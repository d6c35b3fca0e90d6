"""Tests that jobs with SH attenuation write exactly the colors that they have optimized."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.library import save
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.quality.measure import Float32Reference
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import StoredHarmonics, held
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.loop import run, stylize
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def make(weights: BackboneWeights, scene: Scene, **values: Any) -> Stylizer:
    settings = make_settings(steps_coarse=0, steps_sos=3, early_stop=False, **values)
    return Stylizer.planned(scene, cameras(), style(), settings, weights=weights)


def line(stylizer: Stylizer) -> str:
    (decision,) = (each for each in stylizer.job.plan.decisions if each.item == "spherical harmonics")
    return f"{decision.decision}: {decision.reason}"


@pytest.mark.parametrize("attenuation", [0.4, 1.0])
def test_job_is_bit_identical_to_that_of_an_attenuated_scene(tiny_weights: BackboneWeights, attenuation: float) -> None:
    scene = wall(sh_degree=2)
    stylizer = make(tiny_weights, scene, sh_attenuation=attenuation)
    came = replace(scene, sh_rest=held(scene.sh_rest) * torch.tensor(1 - attenuation, dtype=torch.float32))
    other = make(tiny_weights, came.without_zero_bands())
    for each in (stylizer, other):
        run(each)
    assert torch.equal(stylizer.stylized(), other.stylized())
    assert [record.loss for record in stylizer.history] == [record.loss for record in other.history]
    assert stylizer.job.scene.sh_degree == (0 if attenuation == 1 else 2)
    assert stylizer.job.sh_degree == 2
    exact = Float32Reference(stylizer).evaluate(stylizer.job.evaluation_views, stylizer.stylized())
    assert exact.keys() == stylizer.evaluate(stylizer.job.evaluation_views).keys()
    for scale, terms in stylizer.evaluate(stylizer.job.evaluation_views).items():
        assert exact[scale].total == pytest.approx(terms.total, rel=1e-6)


@pytest.mark.parametrize(("held_bytes", "attenuation"), [(0, 0.4), (None, 1.0)])
def test_written_result_renders_as_optimized(
    tiny_weights: BackboneWeights, tmp_path: Path, held_bytes: int | None, attenuation: float
) -> None:
    write_scene(tmp_path / "scene.ply", wall(sh_degree=1))
    source = read_scene(tmp_path / "scene.ply", held_bytes=held_bytes)
    assert isinstance(source.scene.sh_rest, StoredHarmonics) == (held_bytes == 0)
    settings = make_settings(steps_coarse=0, steps_sos=2, sh_attenuation=attenuation)
    values = settings.model_dump(exclude={"preset"})
    stylized = stylize(source, cameras(), style(), weights=tiny_weights, **values)
    save(tmp_path / "out.ply", stylized)
    result = read_scene(tmp_path / "out.ply").scene
    stylizer = Stylizer.planned(source.scene, cameras(), style(), settings, weights=tiny_weights)
    stylizer.set_colors(stylized.scene.sh_dc)
    again = Stylizer.planned(result, cameras(), style(), make_settings(warm_start=False), weights=tiny_weights)
    for index in range(3):
        images = [
            each.job.views.render(index, each.job.views.colors(index, each.sh_dc.detach()))
            for each in (stylizer, again)
        ]
        assert torch.equal(*images)


def test_plan_describes_the_attenuation(tiny_weights: BackboneWeights) -> None:
    assert "there is nothing to attenuate" in line(make(tiny_weights, wall(), sh_attenuation=0.5))
    assert "multiplied by 0.75" in line(make(tiny_weights, wall(sh_degree=1), sh_attenuation=0.25))
    out = make(tiny_weights, wall(sh_degree=1), sh_attenuation=1)
    assert "attenuated to 0, in the result too; no view directions are computed" in line(out)
    assert out.job.views.scene.sh_degree == 0
