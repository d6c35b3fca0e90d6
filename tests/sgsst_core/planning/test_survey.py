"""Tests of surveying views, and of reusing a survey."""

from __future__ import annotations

import pytest
import torch

from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.planning.survey import progress_of, survey_views
from sgsst_core.progress import Progress
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import blind_camera, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def test_survey_reports_its_progress() -> None:
    scene, reports = wall(), list[Progress]()
    survey_views(scene, cameras(3), make_rasterizer("cpu", scene), show=reports.append)
    assert [(progress.step, progress.total) for progress in reports] == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert [progress.fraction for progress in reports] == [0, 1 / 3, 2 / 3, 1]


def test_progress_assumes_that_other_ranks_are_as_fast() -> None:
    reported = [progress_of(done, 5, 2) for done in (0, 2, 3)]
    assert reported == [Progress(stage="planning", step=step, total=5) for step in (0, 4, 5)]


def test_plan_requires_cameras_that_see_the_scene(tiny_weights: BackboneWeights) -> None:
    for views, message in (([], "There are no cameras"), ([blind_camera()], "None of the 1 cameras sees")):
        with pytest.raises(CameraError, match=message):
            plan_job(wall(), views, Style.of(style()), make_settings(), weights=tiny_weights)


def test_earlier_survey_is_reused(tiny_weights: BackboneWeights) -> None:
    scene, settings, reports = wall(), make_settings(), list[Progress]()
    first = plan_job(scene, cameras(2), Style.of(style()), settings, weights=tiny_weights).plan
    second = plan_job(
        scene, cameras(2), Style.of(style()), settings, weights=tiny_weights, survey=first.survey, show=reports.append
    ).plan
    assert not reports
    assert second.survey is first.survey
    assert torch.equal(second.seen, first.seen)


def test_requested_rasterizer_is_used(tiny_weights: BackboneWeights) -> None:
    settings = make_settings(cached_weights="none")
    stylizer = Stylizer.planned(wall(), cameras(1), style(), settings, weights=tiny_weights, rasterizer="reference")
    assert stylizer.job.views.rasterizer.name == stylizer.job.plan.rasterizer == "reference"
