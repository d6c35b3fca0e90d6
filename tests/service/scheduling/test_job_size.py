"""Tests of the number of GPUs that a job should get by its estimated size, and of the estimate against the forecast."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks import forecast
from service.scheduling.job_size import JobSize, estimated_size

GB = 1_000_000_000


def size_of(scene: int = GB, name: str = "scene.ply", photos: int = 0, **parameters: Any) -> JobSize:
    inputs: list[dict[str, Any]] = [{"role": "scene", "name": name, "size": scene}]
    inputs += [{"role": "photos", "name": f"{number}.jpg", "size": photos} for number in range(3) if photos]
    return estimated_size(parameters, [*inputs, {"role": "style", "name": "style.jpg", "size": GB}])


@pytest.mark.parametrize("name", forecast.JOBS)
@pytest.mark.parametrize("precision", forecast.PRECISIONS)
def test_estimated_seconds_agree_with_the_forecast(name: str, precision: str) -> None:
    job, device = forecast.JOBS[name], forecast.DEVICES["H200"]
    parts = forecast.step_parts(job, device, precision)
    step = forecast.step_seconds(parts, forecast.SHARES["likely"], device, precision)["total"]
    estimated = JobSize(job.gaussians, job.size[0] * job.size[1], 0, 1, precision).seconds()
    assert step / 1.6 < estimated < step * 1.6


def test_estimated_gaussians_do_not_depend_on_the_format() -> None:
    gaussians = size_of(248_000_000).gaussians
    assert gaussians == 1e6
    for name, scene in (
        ("s.compressed.ply", 61_000_000),
        ("s.SPZ", 25_000_000),
        ("s.splat", 32_000_000),
        ("x", 248_000_000),
    ):
        assert size_of(scene, name).gaussians == gaussians


def test_view_size_follows_the_resolution_or_the_photos() -> None:
    assert size_of(resolution=1000).pixels == 625_000
    assert size_of(photos=6_000_000, resolution=1000).pixels == 625_000
    assert size_of(photos=6_000_000).pixels == pytest.approx(6_000_000 / 0.35)
    assert size_of(photos=6_000_000, preset="preview").pixels == 0.625 * 640**2
    assert size_of(max_resolution=800, resolution=1000).pixels == 0.625 * 800**2


def test_steps_default_to_the_preset() -> None:
    assert (size_of().steps_coarse, size_of().steps_sos) == (100, 200)
    assert size_of(preset="paper", steps_sos=7, views_per_step=3).steps_sos == 21


def test_unknown_stored_parameters_are_estimated_as_defaults() -> None:
    assert size_of(steps_sos="many", preset="unknown", resolution="large", bygone=1) == size_of()


@pytest.mark.parametrize(
    ("parameters", "gpus"),
    [({"preset": "preview"}, [1]), ({"preset": "paper", "resolution": 5187}, [8]), ({"resolution": 5187}, range(6, 9))],
)
def test_larger_jobs_get_more_gpus(parameters: dict[str, Any], gpus: Any) -> None:
    assert size_of(**parameters).gpus(8) in gpus


def test_gpu_count_is_between_one_and_the_maximum() -> None:
    for steps in (0, 1, 10_000_000):
        for most in (1, 3, 64):
            assert 1 <= size_of(steps_sos=steps).gpus(most) <= most
