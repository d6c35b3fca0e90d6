"""Tests of rates that jobs leave behind, of estimates from them, and of the remaining time that a job shows."""

import json
import math
from pathlib import Path

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.progress import Progress
from sgsst_core.settings import PlannedPrecision, make_settings
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.planner import Rates, estimate
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Use an empty cache folder, and return the file of the rates."""
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "rates.json"


@pytest.fixture
def network(tiny_weights: BackboneWeights) -> FeatureNetwork:
    return FeatureNetwork(tiny_weights)


def rates(network: FeatureNetwork, precision: PlannedPrecision = "float32") -> Rates:
    return Rates(network, precision, make_settings())


def test_rate_of_the_nearest_size_is_remembered_and_merged(cache: Path, network: FeatureNetwork) -> None:
    known = rates(network)
    known.remember(1000, 4.0)
    known.remember(1_000_000, 100.0)
    actual = [known.rate(pixels) for pixels in (1, 1000, 20_000, 100_000, 1e9)]
    assert actual == pytest.approx([4.0, 4.0, 4.0, 100.0, 100.0])
    known.remember(1000, 16.0)
    assert rates(network).rate(1000) == pytest.approx(8.0), "the geometric mean"
    rates(network, "winograd").remember(1000, 1.0)
    assert known.rate(1000) == pytest.approx(8.0)
    assert len(json.loads(cache.read_text())) == 2


@pytest.mark.parametrize("content", [None, "", "[1]", '{"a": 1}', '{"a": {"b": "c"}}', '{"a": {"b": 1}}', "\x00\xff"])
def test_unknown_rate_is_tried_on_a_small_image(cache: Path, network: FeatureNetwork, content: str | None) -> None:
    if content is not None:
        cache.parent.mkdir()
        cache.write_text(content, "latin-1")
    state = torch.random.get_rng_state()
    assert 0 < rates(network).rate(1000) < math.inf
    assert torch.equal(torch.random.get_rng_state(), state)
    rates(network).remember(1000, 3.0)
    assert rates(network).rate(1000) == pytest.approx(3.0)


def test_remaining_time_follows_the_estimate_then_the_own_pace(cache: Path, tiny_weights: BackboneWeights) -> None:
    """An earlier job has left behind a rate of a pixel per second, as if steps took hours."""
    stylizer = Stylizer.planned(
        wall(10, 8), cameras(2, 32, 24), style(), make_settings("preview", steps_sos=13), weights=tiny_weights
    )
    job, seen = stylizer.job, list[Progress]()
    Rates(job.network, job.plan.precision, job.settings).remember(job.plan.work.sos, 1.0)
    expected = estimate(job)
    assert expected.seconds == pytest.approx(job.plan.work.sos + 2 * job.survey_seconds)
    assert expected.job == pytest.approx(13 * expected.seconds + expected.measuring)
    run(stylizer, Callbacks(progress=seen.append, progress_seconds=0))
    left = [progress.eta_s or 0.0 for progress in seen]
    steps = [13 - progress.step for progress in seen]
    assert left[:9] == pytest.approx([each * expected.seconds + expected.ending for each in steps[:9]], rel=0.02)
    assert all(0 < each < 0.1 * expected.seconds for each in left[9:])
    (remembered,) = json.loads(cache.read_text()).values()
    assert all(rate > 1 for rate in remembered.values()), "this job's rate is merged"


def test_budget_limits_the_shown_time_and_its_end_leaves_a_rate_behind(
    cache: Path, tiny_weights: BackboneWeights
) -> None:
    stylizer = Stylizer.planned(
        wall(10, 8), cameras(2, 32, 24), style(), make_settings("preview", steps_sos=3), weights=tiny_weights
    )
    job, seen = stylizer.job, list[Progress]()
    Rates(job.network, job.plan.precision, job.settings).remember(job.plan.work.sos, 1.0)
    callbacks = Callbacks(progress=seen.append, progress_seconds=0, left=lambda: 100.0 if stylizer.step < 2 else 0.0)
    assert run(stylizer, callbacks) == "within"
    assert [progress.eta_s for progress in seen] == [100.0, 0.0]
    (remembered,) = json.loads(cache.read_text()).values()
    assert all(rate > 2 for rate in remembered.values())


@pytest.mark.parametrize("stored", ["0", "-1", "NaN", "Infinity"])
def test_stored_rate_that_no_machine_has_is_ignored(cache: Path, network: FeatureNetwork, stored: str) -> None:
    rates(network).remember(1000, 3.0)
    cache.write_text(cache.read_text().replace("3.0", stored))
    assert 0 < rates(network).rate(1000) < math.inf
    rates(network).remember(1000, 4.0)
    assert rates(network).rate(1000) == pytest.approx(4.0)
