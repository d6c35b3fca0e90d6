"""Tests on a simulated GPU that steps with CUDA graphs of the loss are bit-identical, and need few launches."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sgsst_core.stylizing.job import JobInputs

if torch.cuda.is_available():
    pytest.skip("there is a GPU, which does not pretend", allow_module_level=True)

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.loss.graphs import FIRST_VISITS
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import survey_views
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.settings import PlannedBackground, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import prepare_job
from sgsst_core.stylizing.stylizer import Stylizer
from tests.pretend_cuda.counts import Counts
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.small_scenes import ball, cameras, style, wall

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")

#: Maximum number of launches of a step outside its graph, with views, style and intersections cached.
MOST_LAUNCHES = 60


def test_kernels_run_on_the_device_of_their_data(counts: Counts, tiny_weights: BackboneWeights) -> None:
    """The caller's current device may be another one, as in a new thread."""
    stylizer = make(tiny_weights, graphs=False, scan=True, steps_coarse=0, steps_sos=2)
    torch.cuda.set_device(1)
    stylizer.run_step()
    assert torch.cuda.current_device() == 1
    assert stylizer.step == 1


def make(
    weights: BackboneWeights,
    *,
    graphs: bool,
    scan: bool = False,
    rasterizer: str = "triton",
    training_background: PlannedBackground = "background",
    **values: Any,
) -> Stylizer:
    """Make a job with two views and two scales, and by default three steps per phase."""
    scene, views = ball(40) if scan else wall(10, 8), cameras(2, 48, 32)
    own = {"coarsest_side": 16, "steps_coarse": 3, "steps_sos": 3, "scale_sampling": 1, **values}
    settings = make_settings(**own)
    survey = survey_views(scene, views, make_rasterizer("cpu", scene))
    some = survey.total_blend_weights > 0
    plan = Plan(
        survey=survey,
        optimized=some,
        seen=some,
        covered=tuple(survey.covered),
        weighted=scan,
        training_background=training_background,
        steps_coarse=settings.steps_coarse,
        memory_limit=10**9,
        device="cuda",
        rasterizer=rasterizer,
        uncached=rasterizer,
        graphs=graphs,
    )
    return Stylizer(prepare_job(plan, JobInputs(scene, views, Style.of(style()), settings, weights=weights)))


@pytest.mark.slow
@pytest.mark.parametrize("scan", [False, True])
def test_steps_with_graphs_are_bit_identical(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, scan: bool
) -> None:
    """In both phases, the first of two views that share a graph prepares it, and the second is captured."""
    if not scan:  # once is enough for the network's Triton kernels, which are slow in the interpreter
        leave_out_kernels(monkeypatch)
    plain, graphs = (make(tiny_weights, graphs=graphs, scan=scan) for graphs in (False, True))
    for _ in range(plain.job.total_steps):
        expected, stage = plain.run_step(), graphs.phase.stage
        counts.clear()
        actual = graphs.run_step()
        assert (actual.view, actual.loss, actual.terms) == (expected.view, expected.loss, expected.terms)
        if sum(record.stage == stage for record in graphs.history) > FIRST_VISITS:
            assert counts.launches.total() < MOST_LAUNCHES
            assert counts.waits.total() == 1
            assert {"network", "render", "raster_backward"} <= actual.parts.keys()
            assert "vgg_forward" not in actual.parts
    assert graphs.stylized().equal(plain.stylized())
    assert graphs.job.graphs is not None
    assert (graphs.job.graphs.captured, graphs.job.graphs.problem) == (2, None)


@pytest.mark.slow
def test_one_graph_serves_every_background_color(
    counts: Counts, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One graph serves every background color, which causes no wait and no copy."""
    leave_out_kernels(monkeypatch)
    options: dict[str, Any] = {"scan": True, "rasterizer": "triton", "steps_coarse": 0, "steps_sos": 8}
    plain, graphs = (
        make(tiny_weights, graphs=graphs, training_background="random", **options) for graphs in (False, True)
    )
    fixed = make(tiny_weights, graphs=True, **options)
    launches: dict[str, list[tuple[int, int]]] = {"drawn": [], "fixed": []}
    for _ in range(plain.job.total_steps):
        expected = plain.run_step()
        for name, stylizer in (("drawn", graphs), ("fixed", fixed)):
            counts.clear()
            record = stylizer.run_step()
            launches[name].append((counts.waits.total(), counts.copies.total()))
            if name == "drawn":
                assert (record.view, record.loss, record.terms) == (expected.view, expected.loss, expected.terms)
    assert graphs.job.graphs is not None
    assert (graphs.job.graphs.captured, graphs.job.graphs.problem) == (1, None)
    assert launches["drawn"][-1] == launches["fixed"][-1]
    assert launches["drawn"][-1][0] == 1
