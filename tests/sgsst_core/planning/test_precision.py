"""Tests of choosing the network's precision by what the processors compute."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.parallel.collectives import ALONE
from sgsst_core.planning.facts import Device, Machine, describe_machine
from sgsst_core.planning.plan import choose_precision
from sgsst_core.settings import PlannedPrecision, Precision, PresetName, make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.rounding import to_tf32
from tests.small_scenes import ball, cameras, style

pytestmark = pytest.mark.usefixtures("one_thread")
CPU: tuple[PlannedPrecision, ...] = ("winograd",)
AMX: tuple[PlannedPrecision, ...] = ("bfloat16", "winograd")
AMPERE: tuple[PlannedPrecision, ...] = ("float16", "bfloat16", "tf32")


def test_rounding_is_to_nearest_and_even() -> None:
    step = 2.0**-10
    values = torch.tensor([1 + 0.49 * step, 1 + 0.51 * step, 1 + 0.5 * step, 1 + 1.5 * step, -2 - 0.8 * step, 0.0])
    assert to_tf32(values).tolist() == [1.0, 1 + step, 1.0, 1 + 2 * step, -2.0, 0.0]


@pytest.mark.parametrize(
    ("device", "precisions", "requested", "chosen"),
    [
        ("cpu", CPU, "auto", "winograd"),
        ("cpu", AMX, "auto", "bfloat16"),
        ("cpu", (), "auto", "float32"),
        ("cuda", AMPERE, "auto", "float16"),
        ("cuda", ("bfloat16",), "auto", "bfloat16"),  # an AMD GPU
        ("cuda", (), "auto", "float32"),  # an NVIDIA GPU of compute capability 7.5
        *(("cpu", AMX, name, name) for name in ("float32", "winograd", "bfloat16")),
        *(("cuda", AMPERE, name, name) for name in ("float32", "tf32", "bfloat16", "float16")),
    ],
)
def test_precision_is_the_requested_or_the_fastest(
    device: Device, precisions: tuple[PlannedPrecision, ...], requested: Precision, chosen: str
) -> None:
    machine = Machine(device, 1 << 33, precisions=precisions)
    assert choose_precision(make_settings(precision=requested), machine) == chosen
    assert choose_precision(make_settings("paper"), machine) == "float32"


@pytest.mark.parametrize(
    ("device", "precisions", "requested", "needed"),
    [
        ("cpu", CPU, "bfloat16", r"a CPU with matrix units \(AMX\), an AMD GPU, or an NVIDIA GPU .* this CPU is not"),
        ("cpu", AMX, "tf32", "an NVIDIA GPU of compute capability 8.0 or higher, which this CPU is not"),
        ("cpu", AMX, "float16", "an NVIDIA GPU of compute capability 8.0 or higher, which this CPU is not"),
        ("cuda", ("bfloat16",), "float16", "an NVIDIA GPU .* which this GPU is not"),
        ("cuda", (), "bfloat16", ".* an NVIDIA GPU .* which this GPU is not"),
        ("cuda", AMPERE, "winograd", "a CPU, which this GPU is not"),
    ],
)
def test_precision_that_the_processor_lacks_is_refused(
    device: Device, precisions: tuple[PlannedPrecision, ...], requested: Precision, needed: str
) -> None:
    with pytest.raises(SettingsError, match=f"--precision {requested} needs {needed}. Give another one"):
        choose_precision(make_settings(precision=requested), Machine(device, 1 << 33, precisions=precisions))


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [({"amx_bf16": True}, AMX), ({"avx512_bf16": True}, CPU), ({}, CPU), (None, CPU)],
)
def test_cpu_has_bfloat16_with_matrix_units(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool] | None, expected: tuple[PlannedPrecision, ...]
) -> None:
    """Earlier versions of PyTorch have no list of capabilities."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    if capabilities is None:
        monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert set(describe_machine(make_settings(), ALONE).precisions) == set(expected)


def test_every_rank_must_have_the_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory limit is the least one, too."""

    class Others(type(ALONE)):  # type: ignore[misc]
        def all_gather(self, value: Any) -> list[Any]:
            own = dict.fromkeys(("float16", "bfloat16", "tf32"), False) | {"winograd": True}
            return [value, (1000, own, True)] if isinstance(value, tuple) else [value]

    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": True}, raising=False)
    machine = describe_machine(make_settings(), Others())
    assert (machine.precisions, machine.memory_limit, machine.graphs) == (("winograd",), 1000, False)


@pytest.mark.parametrize(("preset", "amx", "chosen"), [("standard", True, "bfloat16"), ("preview", False, "winograd")])
def test_chosen_precision_is_used_said_and_repeatable(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, preset: PresetName, amx: bool, chosen: Precision
) -> None:
    """A job with a chosen precision has the bits of one in which it was requested."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": amx}, raising=False)
    auto, asked = (
        Stylizer.planned(ball(60), cameras(1), style(), make_settings(preset, precision=each), weights=tiny_weights)
        for each in ("auto", chosen)
    )
    lines = [decision for each in (auto, asked) for decision in each.job.plan.decisions if decision.item == "precision"]
    done = "convolutions by Winograd's algorithm" if chosen == "winograd" else f"features in {chosen}"
    assert [line.decision for line in lines] == [done] * 2
    assert [line.reason for line in lines] == ["the fastest that the processor computes", "requested"]
    assert "relative error of the pixel gradient" in lines[0].error
    assert auto.job.plan.precision == auto.job.network.precision == chosen
    assert auto.job.plan.is_approximated == (chosen == "bfloat16")
    assert auto.run_step().loss == asked.run_step().loss
    assert torch.equal(auto.sh_dc, asked.sh_dc)
