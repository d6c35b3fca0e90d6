"""Tests of jobs on a simulated CUDA device: steps need few synchronizations and launches, and memory may run out."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor

from sgsst_core.bench import device_checks
from sgsst_core.budget import memory_for
from sgsst_core.errors import DeviceMemoryError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.files.scene_file import read_scene
from sgsst_core.scene.colors import color_subspace_of
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.stylizer import Stylizer
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.pretend_cuda.runtime import pretend_cuda
from tests.small_scenes import ball, cameras, style, wall, write_files
from worker.execute import Job, dry_run, execute, prepare
from worker.inputs import read_inputs
from worker.job import JobSpec, Result, Resume, SceneRequest
from worker.options import StyleFile, region_options, region_requests
from worker.run import Listener

if torch.cuda.is_available():
    pytest.skip("there is a GPU, on which the tests marked gpu run", allow_module_level=True)
pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread", "tiny_installed")

#: Maximum bytes of a few scalars.
SCALARS = 256


def request_(
    folder: Path, *, scan: bool = False, gray: bool = False, size: tuple[int, int] = (32, 32), **settings: Any
) -> JobSpec:
    """Write the inputs of a job with two tiny views, at least two scales and a few steps; return the request.

    With a gray style, colors stay in a subspace.
    """
    inputs = folder / "inputs"
    inputs.mkdir(parents=True)
    scene = ball(60) if scan else wall(14, 11, sh_degree=1)
    ply, file, style = write_files(inputs, scene, cameras(2, *size))
    if gray:
        with Image.open(style) as image:
            image.convert("L").save(style)
    options = {
        "steps_coarse": 2,
        "steps_sos": 2,
        "coarsest_side": 16,
        "early_stop": False,
        "precision": "float32",
        **settings,
    }
    source = SceneRequest(scene=ply, cameras=file)
    chosen, out = make_settings(**options), folder / "out" / "s.ply"
    return JobSpec(source=source, styles=(StyleFile(style),), out=out, settings=chosen, backbone="vgg16")


def run_job(job: Job, steps: int | None = None) -> Result:
    """Run a job; if `steps` is given, interrupt it after that many steps."""
    listener = Listener(stop=lambda: steps is not None and job.stylizer.step >= steps, warn=pytest.fail)
    return execute(job, listener, checkpoint_seconds=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "scan", "gray", "settings"),
    [
        ("preview", False, True, {"position_weights": "off"}),
        ("standard", True, False, {"precision": "bfloat16", "views_per_step": 2}),
        ("paper", False, False, {"position_weights": "off", "cached_weights": "half"}),
    ],
)
def test_job_runs_resumes_and_reports(
    counts: Counts, tmp_path: Path, preset: str, scan: bool, gray: bool, settings: dict[str, Any]
) -> None:
    """Run survey, plan, both phases, measurements, a checkpoint, a resumed job and the report."""
    asked = request_(tmp_path, scan=scan, gray=gray, preset=preset, **settings)
    first = prepare(asked)
    plan = first.stylizer.job.plan
    assert (plan.device, plan.uncached, plan.weighted) == ("cuda", "triton", scan)
    used, spare = first.stylizer.job.views.rasterizer.caches["intersections"].capacity, plan.spare // 2
    assert plan.cached_weights != "none" or used == memory_for("rasterizer", plan.memory_limit) + spare > spare > 0
    job = first.stylizer.job
    assert (color_subspace_of(job.styles.all, job.settings) is not None) == gray
    assert run_job(first, steps=1).stopped == "interrupted"
    second = prepare(asked, resume=Resume(True))
    assert second.stylizer.job.plan.rasterizer == plan.rasterizer
    result = run_job(second)
    assert (result.stopped, result.steps, result.report_error) == ("finished", 4, None)
    assert result.loss_over_time is not None
    before, after = (read_scene(path).scene for path in (asked.source.scene, asked.out))
    assert not torch.equal(before.sh_dc, after.sh_dc)
    assert torch.isfinite(after.sh_dc).all()
    assert torch.equal(before.means, after.means)


@pytest.mark.slow
@pytest.mark.parametrize(("scan", "gray"), [(False, False), (True, True)])
def test_steady_step_synchronizes_once_and_copies_scalars(
    counts: Counts, tmp_path: Path, scan: bool, gray: bool
) -> None:
    """The first step of a view has one more wait, because it builds the tile intersections."""
    settings: dict[str, Any] = {"steps_coarse": 2, "steps_sos": 4, "position_weights": "on" if scan else "off"}
    stylizer = prepare(request_(tmp_path, scan=scan, gray=gray, size=(64, 48), **settings)).stylizer
    assert (len(stylizer.job.scales(0)), stylizer.job.plan.weighted) == (3, scan)
    seen: set[int] = set()
    for _ in range(stylizer.job.total_steps):
        counts.clear()
        record = stylizer.run_step()
        first = record.view not in seen
        seen.add(record.view)
        assert 1 <= counts.waits.total() <= 1 + first, counts.waits
        assert counts.copies.total() <= SCALARS * (1 + first), counts.copies
    assert (record.stage, first) == ("sos", False)


@pytest.mark.slow
def test_loop_reads_a_step_after_it_has_queued_the_next(tmp_path: Path) -> None:
    """The losses, the colors and what a checkpoint has are those of steps that are read at once."""
    asked, plan = request_(tmp_path, size=(64, 48), steps_coarse=1, steps_sos=4), tmp_path / "plan"
    plan.touch()
    with pretend_cuda():
        dry_run(asked, read_inputs(asked), hand_over=plan)
        expected, stylizer, other = (prepare(asked, plan_file=plan).stylizer for _ in range(3))
        for _ in range(expected.job.total_steps):
            expected.run_step()
        seen, saved, reported = list[tuple[int, int]](), list[int](), list[int]()

        def look() -> bool:
            seen.append((stylizer.step, len(stylizer.history)))
            return False

        callbacks = Callbacks(
            progress=lambda progress: reported.append(progress.step),
            progress_seconds=0,
            stop=look,
            checkpoint=lambda s: saved.append(len(s.state().history)),
            checkpoint_seconds=math.inf,
        )
        assert run(stylizer, callbacks) == "finished"
        assert seen == [(0, 0), (1, 0), (2, 1), (3, 2), (4, 3)]
        assert reported == [1, 2, 3, 5], "the last two are read together"
        assert [record.loss for record in stylizer.history] == [record.loss for record in expected.history]
        assert torch.equal(stylizer.sh_dc.detach().cpu(), expected.sh_dc.detach().cpu())
        callbacks = replace(callbacks, stop=lambda: other.step == 2)
        assert run(other, callbacks) == "interrupted"
        assert saved == [2]


def in_regions(asked: JobSpec) -> JobSpec:
    """Return the job's request with two additional regions: one with its own style, one frozen."""
    options = region_options(
        ["right:half-space=1,0,0,0", "low:half-space=0,1,0,1"], [f"right={asked.styles[0].path}"], ["right=3"], ["low"]
    )
    return asked.model_copy(update={"regions": region_requests(options)})


@pytest.mark.slow
@pytest.mark.parametrize("regions", [False, True])
def test_losses_match_cpu(tmp_path: Path, regions: bool) -> None:
    """Equal losses show that all kernels run in the right order with the right arguments."""
    asked = request_(tmp_path, scan=not regions, size=(64, 48))
    asked = in_regions(asked) if regions else asked
    expected = prepare(asked).stylizer
    with pretend_cuda():
        stylizer = prepare(asked).stylizer
        for _ in range(expected.job.total_steps):
            theirs, ours = expected.run_step(), stylizer.run_step()
            assert (ours.view, ours.loss) == (theirs.view, pytest.approx(theirs.loss, rel=2e-4))
    assert stylizer.job.plan.device == "cuda"
    assert expected.job.plan.device == "cpu"


def test_doctor_explains_why_a_gpu_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "exists", lambda path: str(path) == "/dev/nvidia0")
    finding = device_checks._gpu()
    assert finding.state == "warning"
    assert ("built for CPUs only" if torch.version.cuda is None else "PyTorch cannot use it") in finding.text


#: A view has 64 x 320 pixels; the largest of its tiles has 64 x 192, including halos.
WIDTH, HEIGHT, TILE = 320, 64, 192


class Memory:
    """Memory of the simulated GPU, with space for the activations of this many pixels."""

    def __init__(self) -> None:
        self.pixels = 1 << 30
        self.failures = 0

    def check(self, x: Tensor) -> None:
        if x.shape[2] * x.shape[3] > self.pixels:
            self.failures += 1
            raise torch.OutOfMemoryError("CUDA out of memory.")


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Memory]:
    simulated, convolve = Memory(), FeatureNetwork._convolve

    def convolve_within(network: FeatureNetwork, x: Tensor, step: Any) -> Tensor:
        simulated.check(x)
        return convolve(network, x, step)

    leave_out_kernels(monkeypatch)
    monkeypatch.setattr(FeatureNetwork, "_convolve", convolve_within)
    with pretend_cuda():
        yield simulated


def planned(weights: BackboneWeights, **values: Any) -> Stylizer:
    values = {"coarsest_side": 16, "position_weights": "off", "scale_sampling": 1, "precision": "float32", **values}
    settings = make_settings(steps_coarse=0, steps_sos=3, **values)
    return Stylizer.planned(
        wall(10, 8), cameras(1, WIDTH, HEIGHT), style(), settings, weights=weights, rasterizer="cpu"
    )


def test_job_continues_with_half_of_its_activations(memory: Memory, tiny_weights: BackboneWeights) -> None:
    expected, actual = planned(tiny_weights), planned(tiny_weights)
    assert len(expected.job.loss.tiling.tiles((HEIGHT, WIDTH))) == 1
    for step in range(3):
        memory.pixels = 1 << 30
        loss = expected.run_step().loss
        if step:
            memory.pixels = TILE * HEIGHT
        assert actual.run_step().loss == pytest.approx(loss, rel=1e-4)
    assert memory.failures == 1
    assert len(actual.job.loss.tiling.tiles((HEIGHT, WIDTH))) > 1
    assert actual.step == 3
    torch.testing.assert_close(actual.sh_dc.cpu(), expected.sh_dc.cpu(), rtol=1e-3, atol=1e-4)


def test_too_little_memory_is_a_clear_error(memory: Memory, tiny_weights: BackboneWeights) -> None:
    stylizer = planned(tiny_weights)
    before, memory.pixels = stylizer.sh_dc.cpu().clone(), 100
    with pytest.raises(DeviceMemoryError, match=r"not even with half .* smaller --memory-limit than 105\.2 GB"):
        stylizer.run_step()
    assert memory.failures == 2
    assert stylizer.step == 0
    assert torch.equal(stylizer.sh_dc.cpu(), before)
