"""Tests of the JSON document of a report, and of the contact sheet."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from api.cli.console import loss_text
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.loss.terms import LossTerms
from sgsst_core.progress import percent
from sgsst_core.report.document import REPORT_VERSION, Sources, build_report, loss_over_time
from sgsst_core.report.images import write_contact_sheet, write_grid
from sgsst_core.report.page import relative_losses, render_page, round_length, running_mean
from sgsst_core.scales import smoothed
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.loop import Stopped, run
from sgsst_core.stylizing.stylizer import Evaluation, StepRecord, Stylizer, mean_loss, round_evaluation, round_loss
from tests.sgsst_core.report.test_page import parsed
from tests.small_scenes import ball, blind_camera, cameras, style

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def finished(tiny_weights: BackboneWeights) -> tuple[Stylizer, Evaluation, Evaluation]:
    """Run a job of seven steps on six views of a ball, one of which sees nothing.

    Return the job, and the loss evaluations before and after.
    """
    views = [*cameras(3), blind_camera(), *cameras(2)]
    plain: dict[str, Any] = {
        "training_background": "background",
        "warm_start": False,
    }  # makes the losses of steps comparable with the start's
    settings = make_settings(steps_coarse=3, steps_sos=7, learning_rate=0.3, measure=1.0, **plain)
    stylizer = Stylizer.planned(ball(), views, style(), settings, weights=tiny_weights)
    before = stylizer.evaluate(stylizer.job.evaluation_views)
    run(stylizer)
    return stylizer, before, stylizer.evaluate(stylizer.job.evaluation_views)


@pytest.fixture(scope="module")
def sources(tiny_weights: BackboneWeights) -> Sources:
    return Sources(Path("a/scene.ply"), 2, (Path("style.png"),), Path("cameras.json"), None, tiny_weights)


def test_report_describes_the_job(finished: tuple[Stylizer, Evaluation, Evaluation], sources: Sources) -> None:
    stylizer, before, after = finished
    report = build_report(stylizer, sources, "finished", before, after)
    assert report["version"] == REPORT_VERSION
    assert report["graphs"] is None  # there are no graphs on a CPU
    assert report["steps"] == {"coarse": {"planned": 0, "done": 0}, "sos": {"planned": 7, "done": 7}}
    described = {"path": "a/scene.ply", "gaussians": 300, "sh_degree": 0, "dropped": 2, "refined": None}
    assert (report["scene"], report["style"]) == (described, {"path": "style.png", "width": 80, "height": 96})
    assert (report["cameras"]["count"], report["cameras"]["sizes"]) == (6, [[64, 48]])
    assert report["cameras"]["seeing_nothing"] == ["blind"]
    assert report["position_weights"]["used"] is True
    assert 0.3 < report["position_weights"]["uncovered_fraction"] < 1
    assert len(report["backbone"]["sha256"]) == 64
    assert report["settings"] == stylizer.job.settings.model_dump(mode="json")
    assert report["memory"]["peak_bytes"] > 50_000_000
    assert report["memory"]["device_peak_bytes"] is report["plan"]["measured"]["device_bytes"] is None
    page = parsed(json.loads(json.dumps(report)))
    assert "scene.ply in the style of style.png" in page.text
    assert {decision["reason"] for decision in report["plan"]["decisions"]} <= set(page.cells)
    parts = sum(report["seconds_by_part"].values())
    assert 0.2 * report["seconds"] < parts <= report["seconds"] + 0.01


def test_report_has_the_losses_of_the_steps(
    finished: tuple[Stylizer, Evaluation, Evaluation], sources: Sources
) -> None:
    stylizer, before, after = finished
    report = build_report(stylizer, sources, "within", before, after)
    assert (report["stopped"], [entry["step"] for entry in report["history"]]) == ("within", list(range(1, 8)))
    assert 3 not in {entry["view"] for entry in report["history"]}, "the view that sees nothing is skipped"
    for entry, record in zip(report["history"], stylizer.history, strict=True):
        terms = entry["scales"]["0"]
        assert entry["loss"] == record.loss
        assert terms == {**vars(record.terms[0]), "total": record.terms[0].total}
        assert {"gram", "mean", "std", "content"} < terms.keys()
        assert entry["relative"] == pytest.approx(record.loss / mean_loss(before))
        assert sum(entry["parts"].values()) == pytest.approx(sum(record.parts.values()), abs=1e-3)
        assert entry["memory_bytes"] > 50_000_000
        assert entry["device_memory_bytes"] is None
    assert report["loss"]["relative"] == pytest.approx(mean_loss(after) / mean_loss(before))
    assert report["loss"]["relative"] < 1
    assert report["loss"]["views"] == ["view_0", "view_1", "view_0", "view_1"]


def test_loss_after_is_the_mean_of_the_last_round_everywhere(
    finished: tuple[Stylizer, Evaluation, Evaluation], sources: Sources
) -> None:
    """The headline, the text, the end of the chart and the progress state one number."""
    stylizer, before, _ = finished
    length = stylizer.job.round_length
    after = round_evaluation(stylizer.history, length)
    report = build_report(stylizer, sources, "finished", before, after)
    last = [record.loss for record in stylizer.history[-length:]]
    wanted = math.prod(last) ** (1 / length)
    assert mean_loss(after) == pytest.approx(wanted) == pytest.approx(round_loss(stylizer.history, length))
    assert round_length(report) == length
    relative = wanted / mean_loss(before)
    assert report["loss"]["relative"] == pytest.approx(relative)
    assert report["loss_over_time"]["relative"] == pytest.approx(relative)
    assert running_mean(relative_losses(report)[0], length)[-1] == pytest.approx(relative)
    coarse = [StepRecord(1, "coarse", 0, 0.1, 4.0, {1: LossTerms(gram=4.0)}, {}, 0)]
    steps = [StepRecord(n, "sos", 0, 0.1, loss, {0: LossTerms(gram=loss)}, {}, 0) for n, loss in ((2, 1.0), (3, 4.0))]
    assert round_loss(coarse + steps, 5) == pytest.approx(2), "of the current phase only"


def test_loss_over_time_is_reported(finished: tuple[Stylizer, Evaluation, Evaluation]) -> None:
    """With two views per round, the mean of the last two losses counts."""
    stylizer = finished[0]
    history, seconds, covered = stylizer.history, stylizer.seconds, stylizer.job.views.covered
    losses = [8.0, 8.0, 4.0, 4.0, 0.48, 0.48, 0.48]
    stylizer.history = [
        StepRecord(i + 1, "sos", i % 2, 10.0 * (i + 1), loss, {0: LossTerms(gram=loss)}, {}, 0)
        for i, loss in enumerate(losses)
    ]
    stylizer.seconds, stylizer.job.views.covered = 70.0, [0, 1]
    try:
        summary = loss_over_time(stylizer, {0: LossTerms(gram=8.0)}, "converged")
    finally:
        stylizer.history, stylizer.seconds, stylizer.job.views.covered = history, seconds, covered
    assert summary is not None
    assert summary["relative"] == pytest.approx(0.06)
    assert [(entry["relative"], entry["step"]) for entry in summary["reached"]] == [(0.5, 4), (0.2, 5), (0.1, 6)]
    assert summary["last_tenth"] == {
        "seconds": pytest.approx(7.0),
        "from": pytest.approx(0.06),
        "to": summary["relative"],
    }
    assert summary["more_time"] is None


@pytest.mark.parametrize(
    ("stopped", "within", "seconds", "expected"),
    [
        ("finished", None, 70.0, "4 times the time would lower the rest of the loss on these views from 13 %"),
        ("within", 100.0, 75.0, "6 min 40 s instead of 1 min 40 s would lower the rest of the loss on these views"),
        ("within", 100.0, 150.0, None),
        ("converged", None, 70.0, None),
    ],
    ids=["steps", "time budget", "resumed", "early stop"],
)
def test_report_says_whether_more_time_would_pay(
    finished: tuple[Stylizer, Evaluation, Evaluation],
    monkeypatch: pytest.MonkeyPatch,
    stopped: Stopped,
    within: float | None,
    seconds: float,
    expected: str | None,
) -> None:
    """The loss falls with the square root of the steps. The budget has 60 of 240 steps."""
    stylizer = finished[0]
    losses = {step: 8.0 * step**-0.5 for step in range(1, 61)}
    history = [
        StepRecord(step, "sos", step % 5, 1.0, loss, {0: LossTerms(gram=loss)}, {}, 0) for step, loss in losses.items()
    ]
    settings = stylizer.job.settings.model_copy(update={"within": within, "steps_sos": 240})
    for name, value in {"history": history, "seconds": seconds, "step": 60}.items():
        monkeypatch.setattr(stylizer, name, value)
    monkeypatch.setattr(stylizer, "job", replace(stylizer.job, settings=settings))
    summary = loss_over_time(stylizer, {0: LossTerms(gram=8.0)}, stopped)
    assert summary is not None
    more = summary["more_time"]
    if expected is None:
        assert more is None
        return
    assert more["text"].replace("\u00a0", " ").startswith(expected)
    assert more["text"].endswith(f"to about {percent(more['relative'])}.")
    assert more["steps"] == 240
    assert more["relative"] == pytest.approx(smoothed([step**-0.5 for step in range(236, 241)], 5))


def test_initial_loss_of_zero_has_no_ratio(finished: tuple[Stylizer, Evaluation, Evaluation], sources: Sources) -> None:
    stylizer, before, after = finished
    nothing = {scale: LossTerms() for scale in before}
    report = json.loads(json.dumps(build_report(stylizer, sources, "finished", nothing, after), allow_nan=False))
    assert report["loss"]["relative"] is None
    assert set(report["loss"]["relative_by_scale"].values()) == {None}
    assert {record["relative"] for record in report["history"]} == {None}
    assert report["loss_over_time"] is None
    assert "–" in render_page(report, None)
    assert loss_text(mean_loss(nothing), mean_loss(after)).startswith(
        f"0 before, {mean_loss(after):.4g} after; it has risen"
    )
    assert (loss_text(0.0, 0.0), loss_text(4.0, 1.0)) == ("0 before, 0 after", "4 before, 1 after (25.0%)")
    assert "(150.0%); it has risen" in loss_text(2.0, 3.0)


def test_contact_sheet_shows_the_stylized_views(
    finished: tuple[Stylizer, Evaluation, Evaluation], tmp_path: Path
) -> None:
    stylizer, sheets = finished[0], []
    for _ in range(2):
        write_contact_sheet(tmp_path / "s.jpg", stylizer)
        stylizer.sh_dc.detach().neg_()  # twice, so that the colors are the same again
        with Image.open(tmp_path / "s.jpg") as image:
            assert image.format == "JPEG"
            sheets.append(np.asarray(image, dtype=np.float64))
    different = np.abs(sheets[0] - sheets[1]).max(axis=2) > 16
    assert 0.1 < different.mean() < 0.6, "the stylized views differ; style and original are the same"


def test_long_names_of_views_lose_their_middle(tmp_path: Path) -> None:
    images = []
    for name in ("a\n" + "x" * 10**6 + "1", "a\n" + "x" * 10**5 + "1", "a\n" + "x" * 10**6 + "2"):
        write_grid(tmp_path / "s.jpg", [[(name, torch.zeros(4, 6, 3))]])
        images.append((tmp_path / "s.jpg").read_bytes())
    with Image.open(tmp_path / "s.jpg") as image:
        assert image.width < 600
    assert images[0] == images[1] != images[2]
