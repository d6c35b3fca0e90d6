"""Tests of messages between ranks: values are restored bit-identically, and hostile messages are refused."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save
from torch import Tensor

from sgsst_core.errors import SceneError
from sgsst_core.files.photos import Photo
from sgsst_core.loss.terms import LossTerms
from sgsst_core.planning.facts import Machine
from sgsst_core.progress import Decision
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.lens import Lens
from worker.capture import Capture
from worker.outputs import Outputs
from worker.ranks.process_group import decode, encode

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
        [(640, 480)],
        [Photo(Path("a.jpg"), (640, 480), oriented=True)],
        (Decision("axes", "rub", "seen"),),
    ),
    Lens.of("OPENCV", (0.1, -0.02), (640, 480), (500.0, 500.0, 320.0, 240.0)),
    Machine("cpu", 3, problems={"triton": "no GPU"}),
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
        assert decoded[name].dtype == dtype
        assert decoded[name].shape == expected.shape
        assert torch.equal(decoded[name], expected)


def test_arrays_and_dataclasses_of_tensors_round_trip() -> None:
    camera = Camera("a.jpg", 8, 6, 5.0, 5.0, 4.0, 3.0, torch.eye(4, dtype=torch.float64))
    decoded_camera, decoded_flags = decode(encode((camera, np.array([True, False]))))
    assert isinstance(decoded_camera, Camera)
    assert torch.equal(decoded_camera.world_to_camera, camera.world_to_camera)
    assert decoded_flags.dtype == np.bool_
    assert decoded_flags.tolist() == [True, False]


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
        {"error": ["worker.ranks.process_group:import_module", ["antigravity"]]},
        {"error": ["worker.processes:kill", [[]]]},
        {"object": ["pathlib:Path", {}]},
        {"object": ["worker.ranks.rank:RankProcess", {}]},
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
