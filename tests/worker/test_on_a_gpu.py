"""Whole jobs on a pretend CUDA device: what would stop one on a GPU, and what a step asks of it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

if torch.cuda.is_available():
    pytest.skip("there is a GPU, on which the tests marked gpu run", allow_module_level=True)
os.environ.setdefault("TRITON_INTERPRET", "1")  # read when the kernels are first imported

from sgsst_core.files.ply import read_scene
from sgsst_core.settings import make_settings
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.runtime import pretend_cuda
from tests.small_scenes import ball, cameras, wall, write_files
from worker.execute import Result, execute
from worker.prepare import Job, prepare
from worker.request import Resume, SceneRequest, StylizeRequest

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread", "tiny_installed")

#: Bytes of a handful of numbers.
SCALARS = 256


@pytest.fixture
def counts() -> Iterator[Counts]:
    with pretend_cuda() as found:
        yield found


def request_(folder: Path, *, scan: bool = False, **settings: Any) -> StylizeRequest:
    """A job of two tiny views in two scales, a few steps in each phase."""
    inputs = folder / "inputs"
    inputs.mkdir(parents=True)
    scene = ball(60) if scan else wall(14, 11, sh_degree=1)
    ply, file, style = write_files(inputs, scene, cameras(2, 32, 32))
    options = {"steps_coarse": 3, "steps_sos": 3, "coarsest_side": 16, "early_stop": False, **settings}
    source = SceneRequest(scene=ply, cameras=file)
    return StylizeRequest(source, style, None, folder / "out" / "s.ply", "vgg16", False, make_settings(**options))


def go_on(job: Job, steps: int | None = None) -> Result:
    """Run a job; with `steps`, ask it to stop after so many."""
    return execute(
        job,
        progress=lambda progress: None,
        stop=lambda: steps is not None and job.stylizer.step >= steps,
        warn=pytest.fail,
        checkpoint_seconds=0.0,
    )


@pytest.mark.parametrize(
    ("preset", "scan", "settings"),
    [
        ("preview", False, {"position_weights": "off"}),
        ("standard", True, {"precision": "bfloat16", "views_per_step": 2}),
        ("paper", False, {"position_weights": "off", "kept_weights": "half"}),
    ],
)
def test_a_whole_job(counts: Counts, tmp_path: Path, preset: str, scan: bool, settings: dict[str, Any]) -> None:
    """Survey, plan, both phases, measuring, checkpoint, another process that goes on with it, report."""
    asked = request_(tmp_path, scan=scan, preset=preset, **settings)
    first = prepare(asked)
    plan = first.stylizer.plan
    assert (plan.device, plan.anew, plan.weighted) == ("cuda", "triton", scan)
    assert go_on(first, steps=2).stopped == "interrupted"
    second = prepare(asked, resume=Resume(True))
    assert second.stylizer.plan.rasterizer == plan.rasterizer
    result = go_on(second)
    assert (result.stopped, result.step, result.report_error) == ("finished", 6, None)
    assert result.bought is not None
    before, after = read_scene(Path(asked.source.scene)), read_scene(Path(asked.out))
    assert not torch.equal(before.sh_dc, after.sh_dc)
    assert torch.isfinite(after.sh_dc).all()
    assert torch.equal(before.means, after.means)
