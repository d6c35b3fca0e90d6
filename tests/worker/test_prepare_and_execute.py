"""Tests of whole jobs on one rank, from input files to output files, including resuming and a full disk."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sgsst_core.errors import CheckpointError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.formats import by_name
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.planning.plan import Plan
from sgsst_core.progress import Progress
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.checkpoint import load_checkpoint, save_checkpoint, save_plan
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.stylizing.test_refining import large_wall
from tests.small_scenes import cameras, style, wall
from tests.worker.ranks.faults import Fault, small_request
from worker import execute as previews_module
from worker.execute import Job, Previews, dry_run, execute, prepare
from worker.inputs import read_inputs
from worker.job import JobSpec, Result, Resume
from worker.run import Listener

pytestmark = pytest.mark.usefixtures("one_thread", "tiny_installed")


def run_job(
    job: Job, steps: int | None = None, checkpoint_seconds: float = 60.0, warnings: list[str] | None = None
) -> Result:
    """Run a job; if `steps` is given, interrupt it after that many steps."""
    first = job.stylizer.step
    listener = Listener(
        stop=lambda: steps is not None and job.stylizer.step - first >= steps,
        warn=(warnings if warnings is not None else []).append,
    )
    return execute(job, listener, checkpoint_seconds=checkpoint_seconds, run_id="run")


@pytest.fixture
def request_(tmp_path: Path) -> JobSpec:
    return small_request(tmp_path, 8)


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.2)])
def test_transparent_parts_of_photos_get_the_background_of_the_job(
    tmp_path: Path, background: tuple[float, float, float]
) -> None:
    request = small_request(tmp_path, 8, background=background)
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("view_0", "view_1", "view_2"):
        image = Image.new("RGBA", (64, 48), (0, 255, 0, 255))
        image.paste((9, 9, 9, 0), (0, 0, 32, 48))
        image.save(photos / f"{name}.png")
    load = read_inputs(request.model_copy(update={"images": photos})).photo_loader(request.settings.background)
    assert load is not None
    assert load(1)[:, :32].unique(dim=0).unique(dim=1).flatten().tolist() == pytest.approx(list(background))
    assert load(1)[0, 40].tolist() == [0, 1, 0]


def test_job_that_ends_early_has_no_steps_left(request_: JobSpec) -> None:
    reports: list[Progress] = []
    job = prepare(request_)
    ended = execute(job, Listener(progress=reports.append, finish=lambda: job.stylizer.step == 3))
    assert (ended.stopped, ended.steps) == ("on-request", 3)
    assert job.stylizer.measured["novel_views"] is None, "whoever ends a job waits for its result"
    third = next(index for index, now in enumerate(reports) if now.step == 3)
    step, after = reports[third : third + 2]
    assert after.stage == "measuring"
    assert 0 < (after.eta_s or 0) < (step.eta_s or 0)


def test_plan_for_another_device_reuses_the_survey(request_: JobSpec) -> None:
    """The checkpoint is that of a job on a GPU that no longer exists."""
    first = prepare(request_)
    run_job(first, steps=3)
    checkpoint = load_checkpoint(first.outputs.checkpoint, first.fingerprint)
    plan = replace(checkpoint.plan, device="cuda", rasterizer="cuda")
    save_checkpoint(first.outputs.checkpoint, replace(checkpoint, plan=plan), first.fingerprint)
    second = prepare(request_, resume=Resume(True))
    assert (second.stylizer.job.plan.device, second.stylizer.job.plan.rasterizer) == (
        "cpu",
        first.stylizer.job.plan.rasterizer,
    )
    assert second.resumed is not None
    assert second.stylizer.job.plan.survey is second.resumed.plan.survey
    assert run_job(second).stopped == "finished"


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU writes it after planning")
def test_first_preview_precedes_planning(request_: JobSpec, tmp_path: Path) -> None:
    happened: list[tuple[int, list[str]]] = []
    previews, folder = Previews(tmp_path / "previews", 3600, pytest.fail), tmp_path / "previews"

    def names() -> list[str]:
        return sorted(path.name for path in folder.iterdir())

    job = prepare(request_, preview=previews, show_planning=lambda now: happened.append((now.step, names())))
    assert [done for done, _ in happened[:4]] == [0, 1, 2, 3]
    assert all(written == ["step_0000000.jpg"] for _, written in happened)
    first = (tmp_path / "previews" / "step_0000000.jpg").read_bytes()
    execute(job, Listener(warn=pytest.fail), preview=previews)
    assert names() == ["step_0000000.jpg", "thumbnail.jpg"], "the hour is not over"
    assert (tmp_path / "previews" / "step_0000000.jpg").read_bytes() == first
    without = small_request(tmp_path / "without", 8)
    run_job(prepare(without))
    assert request_.out.read_bytes() == without.out.read_bytes()


def test_watchers_get_the_refined_scene(tmp_path: Path) -> None:
    request = small_request(tmp_path, 2, refine=3.0)
    write_scene(request.source.scene, large_wall())
    previews = Previews(tmp_path / "previews", 3600, pytest.fail)
    execute(prepare(request), Listener(warn=pytest.fail), preview=previews)
    shared, result = (read_scene(path).scene for path in (tmp_path / "live" / "scene.ply", request.out))
    assert torch.equal(shared.means, result.means)
    assert len(shared) > len(large_wall())
    assert (tmp_path / "live" / "colors.f16").stat().st_size == 6 * len(shared)


@pytest.mark.parametrize(
    "form", ["ply", *(pytest.param(form, marks=pytest.mark.slow) for form in ("spz", "compressed.ply"))]
)
def test_resume_refines_identically_and_writes_all_gaussians(tmp_path: Path, form: str) -> None:
    jobs = []
    for name in ("whole", "resumed"):
        request = small_request(tmp_path / name, 6, refine=3.0)
        scene = large_wall()
        write_scene(request.source.scene, scene)
        if form != "ply":
            source = request.source.scene.with_name(f"scene.{form}")
            write_scene(source, scene, by_name(form))
            out = request.out.with_name(f"s.{form}")
            moved = request.source.model_copy(update={"scene": source})
            request = request.model_copy(update={"source": moved, "out": out})
        jobs.append(request)
    whole, resumed = jobs
    run_job(prepare(whole))
    assert run_job(prepare(resumed), steps=3).stopped == "interrupted"
    second = prepare(resumed, resume=Resume(True))
    assert second.resumed is not None
    assert second.resumed.state.step == 3
    assert run_job(second).stopped == "finished"
    written = resumed.out.with_name("s.ply")
    assert written.read_bytes() == whole.out.with_name("s.ply").read_bytes()
    report = json.loads(resumed.out.with_name("s.report.json").read_text())
    refined = report["scene"]["refined"]
    assert refined["gaussians_before"] == len(scene)
    assert refined["gaussians"] == report["scene"]["gaussians"] == len(read_scene(written).scene) > len(scene)
    assert refined["lowest_psnr"] >= 40
    if form != "ply":
        assert len(read_scene(resumed.out).scene) == refined["gaussians"]
    assert "splitting large Gaussians" in resumed.out.with_name("s.report.html").read_text()


def test_report_has_seconds_before_the_first_step(request_: JobSpec) -> None:
    names = ("reading", "survey", "planning", "preparing")
    first = prepare(request_)
    before = dict(first.stylizer.seconds_by_part)
    assert sorted(before) == sorted(names)
    assert all(before[name] > 0 for name in names)
    assert run_job(first, steps=3).stopped == "interrupted"
    second = prepare(request_, resume=Resume(True))
    own = dict(second.stylizer.seconds_by_part)
    assert sorted(own) == ["preparing", "reading"], "the plan is the checkpoint's"
    assert run_job(second).stopped == "finished"
    report = json.loads(Path(request_.out).with_name("s.report.json").read_text())
    for name in names:
        assert report["seconds_by_part"][name] == pytest.approx(before[name] + own.get(name, 0.0), abs=0.002)
    parts = report["seconds_by_part"]
    assert sum(parts.values()) == pytest.approx(report["seconds_total"], abs=0.001 * len(parts))
    assert report["seconds_total"] > report["seconds"] + report["seconds_by_part"]["writing"]
    assert "survey of the views, before the steps" in Path(request_.out).with_name("s.report.html").read_text()


def handed_over(request: JobSpec, file: Path) -> Plan:
    """Return the plan of a dry run, which is handed over in a file."""
    return dry_run(request, read_inputs(request), hand_over=file).plan


def test_job_reuses_the_plan_of_its_dry_run(tmp_path: Path) -> None:
    whole, request = (small_request(tmp_path / name, 4) for name in ("whole", "again"))
    run_job(prepare(whole))
    plan = handed_over(request, tmp_path / "plan")
    shown: list[Progress] = []
    job = prepare(request, plan_file=tmp_path / "plan", show_planning=shown.append)
    assert shown == []
    assert (job.stylizer.job.plan.decisions, run_job(job).stopped) == (plan.decisions, "finished")
    assert request.out.read_bytes() == whole.out.read_bytes()


def test_job_with_other_settings_reuses_the_survey_of_its_dry_run(request_: JobSpec, tmp_path: Path) -> None:
    plan = handed_over(request_, tmp_path / "plan")
    settings = request_.settings.model_copy(update={"memory_limit": 1 << 30})  # the partition depends on it
    shown: list[Progress] = []
    job = prepare(
        request_.model_copy(update={"settings": settings}), plan_file=tmp_path / "plan", show_planning=shown.append
    )
    assert shown == []
    assert job.stylizer.job.plan.memory_limit == 1 << 30
    assert torch.equal(job.stylizer.job.plan.survey.total_blend_weights, plan.survey.total_blend_weights)


@pytest.mark.parametrize("wrong", ["missing", "damaged", "other job", "other scene"])
def test_job_plans_if_its_dry_run_is_not_usable(wrong: str, request_: JobSpec, tmp_path: Path) -> None:
    file, asked = tmp_path / "plan", request_
    if wrong == "other job":
        settings = request_.settings.model_copy(update={"seed": 1})
        asked = request_.model_copy(update={"settings": settings})
    if wrong != "missing":
        plan = handed_over(asked, file)
    if wrong == "damaged":
        file.write_bytes(file.read_bytes()[:-100])
    if wrong == "other scene":  # as from a process that a hostile file has taken over
        job = prepare(request_)
        save_plan(file, replace(plan, seen=plan.seen[:-1]), job.fingerprint, "")
    shown: list[Progress] = []
    prepare(request_, plan_file=file, show_planning=shown.append)
    assert [progress.step for progress in shown if progress.stage == "planning"] == [0, 1, 2, 3]


def test_optional_resume_starts_without_checkpoint(request_: JobSpec) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint to resume from"):
        prepare(request_, resume=Resume(True))
    assert prepare(request_, resume=Resume(True, required=False)).resumed is None
    run_job(prepare(request_), steps=2)
    assert prepare(request_, resume=Resume(True, required=False, run="another run")).resumed is None
    resumed = prepare(request_, resume=Resume(True, required=False, run="run")).resumed
    assert resumed is not None
    assert resumed.state.step == 2


def test_temporarily_full_disk_is_a_warning(request_: JobSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    # Undone after the test, unlike the fault's own change.
    monkeypatch.setattr("worker.execute.save_checkpoint", save_checkpoint)
    fault = Fault(0, "checkpoint", 2, "full")
    fault.write(request_)
    fault.arm(request_)
    warnings: list[str] = []
    assert run_job(prepare(request_), checkpoint_seconds=0, warnings=warnings).stopped == "finished"
    assert len(warnings) == 1
    assert "The checkpoint could not be written" in warnings[0]
    assert len(read_scene(request_.out).scene) == 616
    left = {path.suffix for path in request_.out.parent.iterdir()}
    assert ".safetensors" not in left
    report = json.loads(request_.out.with_name("s.report.json").read_text())
    assert report["workers"]["used"] == report["workers"]["requested"] == 1
    assert report["workers"]["attempts"] == []
    assert report["seconds_by_part"]["reading"] > 0


def test_colors_file_matches_the_result(request_: JobSpec, tmp_path: Path) -> None:
    write_scene(request_.source.scene, wall(sh_degree=1))
    for request in (request_.model_copy(update={"colors": True}), small_request(tmp_path / "not", 1)):
        run_job(prepare(request))
        alone = request.out.with_name("s.colors.f16")
        assert alone.exists() == request.colors
        if request.colors:
            exact = read_scene(request.out).scene.sh_dc
            colors = np.fromfile(alone, "<f2").reshape(-1, 3)
            assert colors.shape == exact.shape
            assert np.array_equal(colors, exact.numpy().astype(np.float16))


@pytest.fixture
def stylizer(tiny_weights: BackboneWeights) -> Stylizer:
    """Return a job of three steps, with Gaussians that no view shows."""
    settings, scene = make_settings("standard", steps_coarse=0, steps_sos=3, coarsest_side=24), wall()
    scene.means[:5] += 1000
    return Stylizer.planned(scene, cameras(), style(), settings, weights=tiny_weights)


def test_thumbnail_shows_the_scene_on_the_left_and_the_result_on_the_right(stylizer: Stylizer, tmp_path: Path) -> None:
    run(stylizer)
    missing: list[str] = []
    Previews(tmp_path, 3600, missing.append).finish(stylizer)
    assert not missing
    (written,) = tmp_path.iterdir()
    assert written.name == "thumbnail.jpg"
    assert written.name > "step_9999999.jpg", "clients show the last preview by name"

    views, index = stylizer.job.views, stylizer.job.evaluation_views[0]
    thumbnail = np.asarray(Image.open(written), dtype=np.float64)
    middle = thumbnail.shape[1] // 2
    for part, colors in ((np.s_[:, :middle], views.scene.sh_dc), (np.s_[:, middle:], stylizer.shown())):
        with torch.no_grad():
            image = views.rasterizer.render(views.colors(index, colors), views.cameras[index])
        wanted = (image.clamp(0, 1) * 255).numpy()[part]
        assert np.abs(thumbnail[part] - wanted).mean() < 5  # JPEG


def test_live_colors_are_those_of_the_step(stylizer: Stylizer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_COLOR_SECONDS", "_COLOR_SHARE"):
        monkeypatch.setattr(previews_module, name, 0)
    monkeypatch.setattr(previews_module, "_COST_SHARE", 1e9)
    missing: list[str] = []
    previews, by_step = Previews(tmp_path / "previews", 3600, missing.append), {}

    def preview(stylizer: Stylizer) -> None:
        previews(stylizer)
        if not stylizer.step:
            return
        seen = stylizer.job.plan.seen
        wanted = stylizer.job.scene.sh_dc.clone()
        wanted[seen] = stylizer.shown().cpu()
        assert not seen[:5].any()
        by_step[stylizer.step] = np.fromfile(tmp_path / "live" / "colors.f16", "<f2").reshape(-1, 3)
        np.testing.assert_array_equal(by_step[stylizer.step], wanted.numpy().astype("<f2"))

    run(stylizer, Callbacks(preview=preview, preview_seconds=0))
    assert by_step.keys() == {1, 2, 3}
    assert not np.array_equal(by_step[1], by_step[2])
    assert not missing
    assert [path.name for path in (tmp_path / "live").iterdir()] == ["colors.f16"]
