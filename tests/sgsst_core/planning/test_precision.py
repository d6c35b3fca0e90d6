"""Tests of measuring speedup and gradient error of lower precisions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.parallel.collectives import ALONE
from sgsst_core.planning import context as module
from sgsst_core.planning.context import convolution_ratio, equip, gradient_error, precision_ratio
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.rounding import RoundedToTf32, to_tf32
from tests.small_scenes import ball, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def error_of(network: FeatureNetwork, weights: BackboneWeights) -> Difference | None:
    settings = make_settings(memory_limit=2 << 30)
    context = equip(wall(sh_degree=1), cameras(1), settings, weights, ALONE, "cpu")
    return gradient_error(replace(context, network=network), cameras(1)[0])


def test_tf32_gradient_error_is_a_thousandth_without_flipped_decisions(vgg16_weights: BackboneWeights) -> None:
    """Most of the error of a lower precision comes from flipped ReLU and max-pool decisions.

    The number of flips is proportional to the rounding error, so the gradient error is proportional to its square root.
    """
    flipping = error_of(RoundedToTf32(vgg16_weights), vgg16_weights)
    deciding = error_of(RoundedToTf32(vgg16_weights, decisions=FeatureNetwork(vgg16_weights)), vgg16_weights)
    bfloat16 = error_of(FeatureNetwork(vgg16_weights, dtype=torch.bfloat16), vgg16_weights)
    assert deciding is not None
    assert flipping is not None
    assert bfloat16 is not None
    print(f"TF32: {flipping}, without flips: {deciding}; bfloat16: {bfloat16}")
    assert 1e-4 < deciding.relative_error < 3e-3
    assert deciding.relative_error < 0.1 * flipping.relative_error
    assert 1e-2 < flipping.relative_error < 0.6 * bfloat16.relative_error < 0.3
    assert 0.95 < bfloat16.cosine < flipping.cosine < deciding.cosine <= 1


def test_float32_has_no_gradient_error_and_tf32_on_a_cpu_is_float32(tiny_weights: BackboneWeights) -> None:
    assert error_of(FeatureNetwork(tiny_weights), tiny_weights) is None
    assert error_of(FeatureNetwork(tiny_weights, tf32=True), tiny_weights) == Difference(0.0, pytest.approx(1.0))  # type: ignore[arg-type]


def test_rounding_is_to_nearest_and_even() -> None:
    step = 2.0**-10
    values = torch.tensor([1 + 0.49 * step, 1 + 0.51 * step, 1 + 0.5 * step, 1 + 1.5 * step, -2 - 0.8 * step, 0.0])
    assert to_tf32(values).tolist() == [1.0, 1 + step, 1.0, 1 + 2 * step, -2.0, 0.0]


# --- speedup -------------------------------------------------------------------------------------------------------


def test_convolutions_are_timed_in_available_precisions() -> None:
    assert convolution_ratio("bfloat16", "cpu") > 0
    assert precision_ratio("bfloat16", "cpu", ALONE) is not None
    assert precision_ratio("tf32", "cpu", ALONE) is None


@pytest.mark.parametrize(
    ("capabilities", "ratio"), [({"avx512_bf16": True}, 3.0), ({"amx_bf16": False}, None), (None, None)]
)
def test_bfloat16_is_measured_beside_float32_unless_emulated(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool] | None, ratio: float | None
) -> None:
    """Without the list of capabilities, as in earlier versions of PyTorch, nothing is measured."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    if capabilities is None:
        monkeypatch.delattr(torch.cpu, "get_capabilities")
    monkeypatch.setattr(module, "convolution_ratio", lambda precision, device: 3.0 * (precision == "bfloat16"))
    assert precision_ratio("float32", "cpu", ALONE) == ratio


def test_one_thread_is_timed_on_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[int] = []

    def time(precision: str, device: str) -> float:
        threads.append(torch.get_num_threads())
        return 1.0

    monkeypatch.setattr(module, "_convolution_seconds", time)
    torch.set_num_threads(2)
    assert convolution_ratio("bfloat16", "cpu") == 1.0
    assert (threads, torch.get_num_threads()) == ([1, 1], 2)


def test_tf32_needs_every_rank_to_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    class Others(type(ALONE)):  # type: ignore[misc]
        def all_gather(self, value: Any) -> list[Any]:
            return [value, has_it]

    monkeypatch.setattr(module, "has_tf32", lambda device: True)
    monkeypatch.setattr(module, "convolution_ratio", lambda asked, device: 3.0)
    has_it = True
    assert precision_ratio("tf32", "cuda", Others()) == 3.0
    has_it = False
    assert precision_ratio("tf32", "cuda", Others()) is None


def test_tf32_on_a_cpu_gives_the_float32_job(tiny_weights: BackboneWeights) -> None:
    asked, plain = (
        Stylizer.planned(ball(300), cameras(2), style(), make_settings(precision=name), weights=tiny_weights)
        for name in ("tf32", "float32")
    )
    assert asked.job.plan.precision == asked.job.network.precision == "float32"
    assert [decision.decision for decision in asked.job.plan.decisions if decision.item == "precision"] == [
        "features in float32"
    ]
    assert asked.run_step().loss == plain.run_step().loss
    assert torch.equal(asked.sh_dc, plain.sh_dc)
