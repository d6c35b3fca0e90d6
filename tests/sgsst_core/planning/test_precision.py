"""Tests of measuring speedup and gradient error of lower precisions, and of choosing one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.parallel.collectives import ALONE
from sgsst_core.planning import context as module
from sgsst_core.planning.choices import choose_precision, compares_precisions
from sgsst_core.planning.context import (
    Comparison,
    Hardware,
    available_precisions,
    compare_precisions,
    compared_gradient,
    convolution_ratio,
    equip,
)
from sgsst_core.planning.plan import Device
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import PlannedPrecision, make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.rounding import RoundedToFloat16, RoundedToTf32, to_tf32
from tests.sgsst_core.stylizing.test_trial import facts
from tests.small_scenes import ball, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def context_of(weights: BackboneWeights) -> module.PlanningContext:
    settings = make_settings(memory_limit=2 << 30)
    return equip(wall(sh_degree=1), cameras(1), settings, weights, ALONE, "cpu")


def error_of(network: FeatureNetwork, weights: BackboneWeights) -> Difference:
    """Return the gradient error of a network on a view of a wall."""
    context, camera = context_of(weights), cameras(1)[0]
    image = context.rasterizer.render(scene_colors(context.scene, camera), camera)
    return Difference.of(*(compared_gradient(context, each, image)[0] for each in (network, context.network)))


def test_tf32_gradient_error_is_a_thousandth_without_flipped_decisions(vgg16_weights: BackboneWeights) -> None:
    """Most of the error of a lower precision comes from flipped ReLU and max-pool decisions.

    The number of flips is proportional to the rounding error, so the gradient error is proportional to its square root.
    """
    flipping = error_of(RoundedToTf32(vgg16_weights), vgg16_weights)
    deciding = error_of(RoundedToTf32(vgg16_weights, decisions=FeatureNetwork(vgg16_weights)), vgg16_weights)
    bfloat16 = error_of(FeatureNetwork(vgg16_weights, dtype=torch.bfloat16), vgg16_weights)
    float16 = error_of(FeatureNetwork(vgg16_weights, dtype=torch.float16), vgg16_weights)
    assert float16.relative_error == pytest.approx(flipping.relative_error, rel=0.2)
    rounded = error_of(RoundedToFloat16(vgg16_weights), vgg16_weights)
    assert rounded.relative_error == pytest.approx(float16.relative_error, rel=0.1)
    print(f"TF32: {flipping}, without flips: {deciding}; bfloat16: {bfloat16}")
    assert 1e-4 < deciding.relative_error < 3e-3
    assert deciding.relative_error < 0.1 * flipping.relative_error
    assert 1e-2 < flipping.relative_error < 0.6 * bfloat16.relative_error < 0.3
    assert 0.95 < bfloat16.cosine < flipping.cosine < deciding.cosine <= 1


def test_tf32_on_a_cpu_has_no_gradient_error(tiny_weights: BackboneWeights) -> None:
    assert error_of(FeatureNetwork(tiny_weights, tf32=True), tiny_weights) == Difference(0.0, pytest.approx(1.0))  # type: ignore[arg-type]


def test_rounding_is_to_nearest_and_even() -> None:
    step = 2.0**-10
    values = torch.tensor([1 + 0.49 * step, 1 + 0.51 * step, 1 + 0.5 * step, 1 + 1.5 * step, -2 - 0.8 * step, 0.0])
    assert to_tf32(values).tolist() == [1.0, 1 + step, 1.0, 1 + 2 * step, -2.0, 0.0]


# --- speedup -------------------------------------------------------------------------------------------------------


def test_precisions_are_compared_on_a_view(tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch) -> None:
    """A precision whose convolutions are not faster is not tried."""
    context = context_of(tiny_weights)
    for ratio in (0.5, 2.0):
        monkeypatch.setattr(module, "convolution_ratio", lambda precision, device, ratio=ratio: ratio)
        compared = compare_precisions(context, cameras(1)[0], ["bfloat16"])["bfloat16"]
        if ratio < 1:
            assert compared == Comparison(ratio)
        else:
            assert compared.error is not None
            assert compared.speedup > 0
            assert 0 < compared.error.relative_error < 1


@pytest.mark.parametrize("precision", ["bfloat16", "winograd"])
def test_convolutions_are_timed(precision: PlannedPrecision) -> None:
    assert convolution_ratio(precision, "cpu") > 0


@pytest.mark.parametrize(
    ("capabilities", "native"), [({"avx512_bf16": True}, True), ({"amx_bf16": False}, False), (None, False)]
)
def test_bfloat16_is_tried_unless_it_is_emulated(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool] | None, native: bool
) -> None:
    """Without the list of capabilities, as in earlier versions of PyTorch, it must be requested."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    if capabilities is None:
        monkeypatch.delattr(torch.cpu, "get_capabilities")
    for requested, expected in (("auto", native), ("bfloat16", True), ("float32", False), ("tf32", False)):
        names = available_precisions(make_settings(precision=requested), "cpu", ALONE)
        assert names == ["winograd"] * (requested == "auto") + ["bfloat16"] * expected


def test_one_thread_is_timed_on_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[int] = []

    def time(precision: str, device: str) -> float:
        threads.append(torch.get_num_threads())
        return 1.0

    monkeypatch.setattr(module, "_convolution_seconds", time)
    torch.set_num_threads(2)
    assert convolution_ratio("bfloat16", "cpu") == 1.0
    assert (threads, torch.get_num_threads()) == ([1, 1], 2)


def test_every_rank_must_have_the_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    class Others(type(ALONE)):  # type: ignore[misc]
        def all_gather(self, value: Any) -> list[Any]:
            return [value, {"tf32": has_it, "float16": has_it, "winograd": False, "bfloat16": True}]

    for name in ("has_tf32", "has_float16", "has_bfloat16_instructions"):
        monkeypatch.setattr(module, name, lambda device: True)
    for has_it in (True, False):
        names = available_precisions(make_settings(), "cuda", Others())
        assert ("tf32" in names) is ("float16" in names) is has_it


# --- choice --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("device", "measured", "chosen"),
    [
        ("cpu", None, "float32"),
        ("cpu", {}, "float32"),
        ("cpu", {"bfloat16": (0.01, None)}, "float32"),
        ("cpu", {"bfloat16": (1.4, 0.3)}, "float32"),
        ("cpu", {"bfloat16": (2.1, 0.1)}, "bfloat16"),
        ("cpu", {"bfloat16": (2.1, 0.9)}, "float32"),
        ("cpu", {"winograd": (1.9, 0.001), "bfloat16": (0.1, None)}, "winograd"),
        ("cpu", {"winograd": (1.9, 0.001), "bfloat16": (2.4, 0.1)}, "winograd"),
        ("cpu", {"winograd": (1.9, 0.001), "bfloat16": (9.0, 0.1)}, "bfloat16"),
        ("cpu", {"winograd": (1.4, 0.001), "bfloat16": (2.4, 0.1)}, "winograd"),
        ("cpu", {"winograd": (0.9, None), "bfloat16": (2.4, 0.1)}, "bfloat16"),
        ("cuda", {"tf32": (5.0, 0.05), "bfloat16": (9.0, 0.15)}, "bfloat16"),
        ("cuda", {"tf32": (8.5, 0.05), "bfloat16": (9.0, 0.15)}, "tf32"),
        ("cuda", {"tf32": (1.2, 0.05), "bfloat16": (9.0, 0.6)}, "tf32"),
        ("cuda", {"tf32": (5.0, 0.05), "float16": (8.9, 0.05), "bfloat16": (9.0, 0.15)}, "float16"),
        ("cuda", {"tf32": (5.0, 0.05), "float16": (8.9, float("inf")), "bfloat16": (9.0, 0.15)}, "bfloat16"),
    ],
)
def test_precision_is_chosen_by_speed_and_error(
    device: Device, measured: dict[PlannedPrecision, tuple[float, float | None]] | None, chosen: str
) -> None:
    compared = (
        None
        if measured is None
        else {
            name: Comparison(speedup, speedup, None if error is None else Difference(error, 0.99))
            for name, (speedup, error) in measured.items()
        }
    )
    known = replace(facts(), machine=Hardware(device, 1 << 33), precisions=compared)
    assert choose_precision(known, make_settings()) == chosen
    assert choose_precision(known, make_settings(precision="float32")) == "float32"
    assert choose_precision(known, make_settings("paper")) == "float32"
    tried = measured and measured.get("bfloat16", (0.0, None))[1] is not None
    assert choose_precision(known, make_settings(precision="bfloat16")) == ("bfloat16" if tried else "float32")


def test_precisions_are_compared_only_for_long_jobs() -> None:
    """Steps of phase 1 count as much as their pixels."""
    size = (545, 980)
    assert compares_precisions([size], make_settings(steps_coarse=0, steps_sos=2))
    assert not compares_precisions([size], make_settings(steps_coarse=0, steps_sos=1))
    assert not compares_precisions([size], make_settings(steps_coarse=100, steps_sos=0, coarsest_side=128))
    assert not compares_precisions([size], make_settings(precision="float32"))
    assert not compares_precisions([size], make_settings("paper"))
    assert compares_precisions([(32, 32)], make_settings(precision="bfloat16"))


def test_measured_precision_is_used_said_and_repeatable(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job with a chosen precision has the bits of one in which it was requested."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    monkeypatch.setattr("sgsst_core.planning.choices._COMPARED_PIXELS", 0)
    for speedup, chosen in ((4.0, "bfloat16"), (2.0, "winograd"), (0.9, "float32")):
        measured = {
            "winograd": Comparison(min(speedup, 1.9), 1.4, Difference(0.001, 1.0)),
            "bfloat16": Comparison(speedup, 1.4, Difference(0.125, 0.99)),
        }
        monkeypatch.setattr(
            "sgsst_core.stylizing.planner.compare_precisions",
            lambda context, camera, names, own=measured: {name: own[name] for name in names},
        )
        auto, asked = (
            Stylizer.planned(ball(300), cameras(2), style(), make_settings(precision=name), weights=tiny_weights)
            for name in ("auto", chosen)
        )
        assert auto.job.plan.precision == auto.job.network.precision == chosen
        line = next(decision for decision in auto.job.plan.decisions if decision.item == "precision")
        done = "convolutions by Winograd's algorithm" if chosen == "winograd" else f"features in {chosen}"
        assert line.decision == done
        assert auto.job.plan.is_approximated == (chosen == "bfloat16")
        assert f"convolutions in bfloat16 are {speedup:.2g} times as fast as in float32" in line.reason
        assert "a view's loss 1.4 times, with an error of 0.12" in line.reason
        assert auto.run_step().loss == asked.run_step().loss
        assert torch.equal(auto.sh_dc, asked.sh_dc)


def test_plans_of_a_time_budget_share_networks_and_their_comparison(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True}, raising=False)
    monkeypatch.setattr("sgsst_core.planning.choices._COMPARED_PIXELS", 0)
    monkeypatch.setattr(module, "convolution_ratio", lambda *_: 1.5)
    make, equipped = Mock(wraps=module.make_network), Mock(wraps=equip)
    monkeypatch.setattr(module, "make_network", make)
    monkeypatch.setattr("sgsst_core.stylizing.planner.equip", equipped)
    job = Stylizer.planned(ball(300), cameras(3), style(), make_settings(within=60), weights=tiny_weights).job
    assert equipped.call_count > 1
    assert sorted(call.args[2] for call in make.call_args_list) == ["bfloat16", "float32", "winograd"]
    assert job.network.precision == job.plan.precision == "winograd"
    line = next(decision for decision in job.plan.decisions if decision.item == "precision")
    assert "convolutions in bfloat16 are 1.5 times as fast" in line.reason


def test_precisions_are_compared_with_float32_after_another_was_chosen(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A later plan of a time budget has the network of the trial."""
    monkeypatch.setattr(module, "convolution_ratio", lambda *_: 1.5)
    first = context_of(tiny_weights)
    chosen = module.make_network(tiny_weights, first.settings, "bfloat16", "cpu")
    networks = module.Networks(created={"bfloat16": chosen})
    later = equip(first.scene, first.cameras, first.settings, tiny_weights, ALONE, "cpu", networks)
    assert later.network is chosen
    errors = [compare_precisions(each, cameras(1)[0], ["bfloat16"])["bfloat16"].error for each in (first, later)]
    assert errors[0] == errors[1]
    assert errors[0] is not None
    assert errors[0].relative_error > 1e-3


def test_short_job_is_not_measured(tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "convolution_ratio", lambda *_: pytest.fail("measured"))
    job = Stylizer.planned(ball(300), cameras(2), style(), make_settings(), weights=tiny_weights).job
    line = next(decision for decision in job.plan.decisions if decision.item == "precision")
    assert (line.decision, job.network.precision) == ("features in float32", "float32")
    assert "too little time" in line.reason


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
