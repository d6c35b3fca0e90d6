"""Tests of collectives against their definitions, of messages, and of what a rank sets when it starts."""

import json
import math
import os
import struct
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import torch.distributed as dist
from safetensors.torch import save
from torch import Tensor

from benchmarks.stability.sos_reference import layer_statistics_reference
from sgsst_core.errors import RanksDriftedError, SceneError
from sgsst_core.features.partition import Rectangle
from sgsst_core.features.statistics import LayerStatistics, layer_statistics
from sgsst_core.files.images import Photo
from sgsst_core.loss.terms import LossTerms
from sgsst_core.messages import decode, encode
from sgsst_core.parallel import Collectives, ImageExchange
from sgsst_core.planning.plan import Machine
from sgsst_core.progress import Decision
from sgsst_core.scene.camera import Camera, Lens
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.networks import tiny_weights
from tests.ports import free_port
from tests.sgsst_core.synthetic_images import relative_error
from tests.small_scenes import cameras, style, wall
from tests.worker.ranks.spawn import on_ranks
from worker.inputs import Capture
from worker.job import Outputs
from worker.ranks.process_group import _backend, _meet
from worker.run import _failure

HEIGHT = 70
ROOT = Path(__file__).resolve().parents[3]

#: Program that compiles an uncached kernel after Numba's threads have started and another number of threads was set.
COLD_CACHE = """
import os, sys
import numba, numpy as np
from worker.run import set_thread_variables

@numba.njit(parallel=True)
def doubled(x):
    for i in numba.prange(x.size):
        x[i] *= 2

doubled(np.ones(8))
set_thread_variables(numba.config.NUMBA_NUM_THREADS + 1)
doubled(np.ones(8, np.float32))
print(os.environ["OMP_NUM_THREADS"])
"""


@pytest.mark.parametrize(
    ("gpus", "expected", "sharing"),
    [((0, 1), "cuda", 1), ((3, 3), "cuda", 2), ((0, None), "cpu", 1), ((None, None), "cpu", 1)],
)
def test_gpus_are_used_if_each_rank_has_one(
    gpus: tuple[int | None, int | None], expected: str, sharing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ranks on one GPU, or on MIG slices of it, recognize each other by its PCI address."""

    def properties(device: torch.device) -> SimpleNamespace:
        return SimpleNamespace(pci_domain_id=0, pci_bus_id=16 + (device.index or 0), pci_device_id=0)

    monkeypatch.setattr(torch.cuda, "get_device_properties", properties)
    address, patience = f"127.0.0.1:{free_port()}", timedelta(seconds=60)
    with ThreadPoolExecutor(2) as ranks:
        devices = [torch.device("cpu") if gpu is None else torch.device("cuda", gpu) for gpu in gpus]
        meeting = [ranks.submit(_meet, rank, 2, address, device, patience) for rank, device in enumerate(devices)]
        groups = [met.result(60) for met in meeting]
    assert [(device.type, shared) for device, shared, _ in groups] == [(expected, sharing)] * 2


def test_nccl_requires_one_rank_per_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    for there, expected in ((True, "cpu:gloo,cuda:nccl"), (False, "gloo")):
        monkeypatch.setattr(dist, "is_nccl_available", lambda there=there: there)
        assert _backend(torch.device("cuda", 0), 1) == expected
        assert _backend(torch.device("cuda", 0), 2) == "gloo"
        assert _backend(torch.device("cpu"), 1) == "gloo"


def image(rank: int, rows: int = HEIGHT) -> Tensor:
    return torch.randn(rows, 9, 3, generator=torch.Generator().manual_seed(rank))


def areas(ranks: int) -> list[Rectangle]:
    """Return disjoint parts of different shapes, of which one is empty with three or more ranks."""
    rectangles = [Rectangle(5, 2, 50, 9), Rectangle(50, 0, HEIGHT, 4), Rectangle(0, 0, 0, 0), Rectangle(0, 0, 5, 9)]
    return rectangles[:ranks]


WHOLE, NOTHING = Rectangle(0, 0, HEIGHT, 9), Rectangle(0, 0, 0, 0)


def window(rank: int, area: Rectangle) -> Tensor:
    return image(rank)[area.slices]


def exchange_parts(collectives: Collectives, windows: list[Rectangle]) -> tuple[Tensor, Tensor]:
    """Exchange two images at once: one with these windows, and one whose windows are the parts of the next rank."""
    parts, rank = areas(collectives.size), collectives.rank
    exchanges = [ImageExchange(parts, windows), ImageExchange(parts, [*parts[1:], parts[0]])]
    filled = [torch.full((*each.windows[rank].shape, 3), 0.5) for each in exchanges]
    collectives.gather_parts(exchanges, [window(7, parts[rank]), window(8, parts[rank])], filled)
    assert torch.equal(filled[1], window(8, exchanges[1].windows[rank]))
    own = [window(rank, each.windows[rank]) for each in exchanges]
    totals = collectives.reduce_parts(exchanges, own)
    assert torch.equal(totals[1], window((rank - 1) % collectives.size, parts[rank]))
    return filled[0], totals[0]


@pytest.mark.parametrize(
    "windows",
    [
        [WHOLE, WHOLE],
        [NOTHING, WHOLE],
        [NOTHING] * 3,
        [Rectangle(3, 1, 53, 5), WHOLE, Rectangle(60, 0, HEIGHT, 9)],
        [Rectangle(10, 3, 20, 8), NOTHING, Rectangle(0, 0, 6, 9), Rectangle(49, 2, 52, 4)],
    ],
)
def test_windows_are_gathered_and_reduced(windows: list[Rectangle]) -> None:
    parts = areas(len(windows))
    gathered, total = torch.full((HEIGHT, 9, 3), 0.5), torch.zeros(HEIGHT, 9, 3)
    for rank, (part, area) in enumerate(zip(parts, windows, strict=True)):
        gathered[part.slices] = image(7)[part.slices]
        total[area.slices] += window(rank, area)
    results = on_ranks(len(windows), exchange_parts, windows)
    for (filled, own), part, area in zip(results, parts, windows, strict=True):
        assert torch.equal(filled, gathered[area.slices])
        assert torch.equal(own, total[part.slices])


def features(rank: int) -> Tensor:
    """Return features whose means are 1e4 standard deviations, with one constant and one zero channel."""
    values = torch.randn(11 + 3 * rank, 7, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(rank))
    values[..., 1] += 1e4
    values[..., 2] = 3.7
    values[..., 3] = 0.0
    return values


def merge(collectives: Collectives, empty: int | None) -> list[tuple[LayerStatistics, float]]:
    """Merge three statistics at once, of which the second has fewer channels."""
    every = [features(collectives.rank), features(collectives.rank)[..., 1:4], features(collectives.rank)]
    own = [
        LayerStatistics.zero(values.shape[-1]) if collectives.rank == empty else layer_statistics(values)
        for values in every
    ]
    merged, added = collectives.all_reduce_statistics(own, torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64))
    return list(zip(merged, added.tolist(), strict=True))


@pytest.mark.parametrize("empty", [None, 0, 2])
def test_merged_statistics_match_one_rank(empty: int | None) -> None:
    present = [features(rank).reshape(-1, 5) for rank in range(3) if rank != empty]
    for result in on_ranks(3, merge, empty):
        for turn, (statistics, number) in enumerate(result):
            channels = torch.cat(present)[None][..., 1:4] if turn == 1 else torch.cat(present)[None]
            expected = layer_statistics_reference(channels)
            assert number == pytest.approx(1.5 * (turn + 1))
            assert float(statistics.count) == float(expected.count)
            assert relative_error(statistics.mean, expected.mean) < 1e-14
            assert relative_error(statistics.std(), expected.std()) < 1e-10
            assert relative_error(statistics.gram(), expected.gram()) < 1e-12
            constant, zero = (1, 2) if turn == 1 else (2, 3)
            assert float(statistics.std()[constant]) < 1e-12
            assert float(statistics.std()[zero]) == 0.0


def values(collectives: Collectives, groups: int) -> dict[str, Any]:
    group = collectives.split_group(groups)
    return {
        "all_gather": collectives.all_gather(collectives.rank),
        "broadcast": collectives.broadcast(lambda: f"made by {collectives.rank}"),
        "group": (group.rank, group.size, group.all_gather(collectives.rank)),
        "all_reduce": float(collectives.all_reduce(torch.tensor([float(collectives.rank)]))),
        "local": collectives.local_size,
    }


@pytest.mark.parametrize("groups", [1, 2, 4])
def test_collectives_and_groups_follow_their_definitions(groups: int) -> None:
    each = 4 // groups
    for rank, result in enumerate(on_ranks(4, values, groups)):
        assert (result["all_gather"], result["broadcast"]) == ([0, 1, 2, 3], "made by 0")
        assert (result["all_reduce"], result["local"]) == (6.0, 4)
        first = rank - rank % each
        assert result["group"] == (rank % each, each, list(range(first, first + each)))


def fail_on_first(collectives: Collectives) -> str:
    def make() -> str:
        raise SceneError("scene.ply: is empty.")

    try:
        return collectives.broadcast(make)
    except SceneError as error:
        return str(error)


def test_error_of_first_rank_is_raised_on_all_ranks() -> None:
    assert on_ranks(2, fail_on_first) == ["scene.ply: is empty."] * 2


def drift(collectives: Collectives) -> str:
    settings = make_settings("standard", steps_coarse=0, steps_sos=60, early_stop=False)
    stylizer = Stylizer.planned(wall(), cameras(1), style(), settings, weights=tiny_weights(), collectives=collectives)
    if collectives.rank == 1:
        stylizer.sh_dc.data[::3] += 1e-6
    try:
        for _ in range(50):
            stylizer.run_step()
    except RanksDriftedError as error:
        return str(error)
    return ""


def test_drifting_ranks_are_detected() -> None:
    for message in on_ranks(2, drift):
        assert message.startswith("Step 50: the ranks' colors are no longer the same.")


VALUES = [
    None,
    True,
    -(2**70),
    "",
    "line\n\udcff \u2028",  # file names that are not UTF-8 contain such characters
    0.1 + 0.2,
    5e-324,
    -0.0,
    math.inf,
    b"ply\r\n\x00\xff",
    [1, (2, [3]), ()],
    {3: "three", "4": 4, (5, 6): {"tuple": [1]}},
    Path("inputs/scene.ply"),
    LossTerms(gram=1 / 3, content=2.0),
    Decision("ranks", "2", "measured", bytes=3),
    Outputs(Path("out/s.ply")),
    Capture(
        [],
        None,
        ("a",),
        [Photo(Path("a.jpg"), oriented=True)],
        (Decision("axes", "rub", "seen"),),
    ),
    Lens.of("OPENCV", (0.1, -0.02), (640, 480), (500.0, 500.0, 320.0, 240.0)),
    Machine("cpu", 3, problem="no GPU"),
]


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_values_round_trip(value: Any) -> None:
    decoded = decode(encode(value))
    assert decoded == value
    assert repr(decoded) == repr(value)  # distinguishes -0.0 from 0.0, tuples from lists, and True from 1


def test_nan_round_trips() -> None:
    assert math.isnan(decode(encode(math.nan)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.int64, torch.uint8, torch.bool])
@pytest.mark.parametrize("shape", [(), (0, 3), (5, 3)])
def test_tensors_round_trip_bit_identical(dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    tensor = (torch.randn(shape, generator=torch.Generator().manual_seed(0)) * 100).to(dtype)
    decoded = decode(encode({"tensor": tensor, "part": tensor.expand(2, *shape)}))
    for name, expected in (("tensor", tensor), ("part", tensor.expand(2, *shape))):
        assert (decoded[name].dtype, decoded[name].shape) == (dtype, expected.shape)
        assert torch.equal(decoded[name], expected)


def test_arrays_and_dataclasses_of_tensors_round_trip() -> None:
    camera = Camera("a.jpg", 8, 6, 5.0, 5.0, 4.0, 3.0, torch.eye(4, dtype=torch.float64))
    decoded_camera, decoded_flags = decode(encode((camera, np.array([True, False]))))
    assert isinstance(decoded_camera, Camera)
    assert torch.equal(decoded_camera.world_to_camera, camera.world_to_camera)
    assert (decoded_flags.dtype, decoded_flags.tolist()) == (np.bool_, [True, False])


def test_errors_keep_their_type() -> None:
    decoded = decode(encode(SceneError("scene.ply: is empty.")))
    assert type(decoded) is SceneError
    assert decoded.args == ("scene.ply: is empty.",)


@pytest.mark.parametrize(
    "value", [object(), {1}, ValueError("no"), Path, len, np.float32(1)], ids=lambda value: type(value).__name__
)
def test_unsupported_values_are_refused(value: Any) -> None:
    with pytest.raises(TypeError, match=r"A message between ranks cannot hold a|is not a class of"):
        encode(value)


def message(value: Any) -> Tensor:
    """Encode any JSON-serializable value as a message."""
    text = torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)
    return torch.frombuffer(bytearray(save({"json": text})), dtype=torch.uint8)


@pytest.mark.parametrize(
    "value",
    [
        {"error": ["builtins:eval", ["1"]]},
        {"error": ["os:system", ["true"]]},
        {"error": ["sgsst_core.scene.camera:Camera", []]},
        {"error": ["sgsst_core.messages:import_module", ["antigravity"]]},
        {"error": ["worker.processes:kill", [[]]]},
        {"object": ["pathlib:Path", {}]},
        {"object": ["worker.run:RankProcess", {}]},
        {"object": ["sgsst_core.planning.plan:Decision", {"__class__": 1}]},
        {"object": ["sgsst_core.planning.plan:Decision.__init__", {}]},
        {"call": ["os.system", "true"]},
        {"tensor": ["7", "cpu"]},
        {"tuple": [], "list": []},
        {},
    ],
    ids=str,
)
def test_messages_cannot_name_other_classes_or_functions(value: Any) -> None:
    with pytest.raises(ValueError, match="not a message of this program"):
        decode(message(value))


@pytest.mark.parametrize("data", [b"", b"\x80\x05N.", struct.pack("<Q", 2**60) + b"{}", b"\x00" * 64])
def test_invalid_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="not a message of this program"):
        decode(torch.tensor(list(data), dtype=torch.uint8))


@pytest.mark.slow
def test_thread_count_can_be_set_after_kernels_ran() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        [sys.executable, "-c", COLD_CACHE], env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) > 1


def test_store_error_is_an_echo_of_a_lost_rank() -> None:
    """Such an error occurs if a rank is lost while the other ranks form their process group."""
    assert _failure(dist.DistStoreError("wait timeout")).echo
    assert not _failure(RuntimeError("wait timeout")).echo
