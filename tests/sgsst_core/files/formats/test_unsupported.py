"""Tests of formats that cannot be read."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from tests.sgsst_core.files.formats.samples import (
    refused,
)


def ksplat() -> bytes:
    head = struct.pack("<4BIIIIHHfff", 0, 1, 0, 0, 1, 1, 616, 616, 1, 0, 0, 0, 0)
    return head + bytes(4096 + 1024 - len(head)) + bytes(616 * 24)


@pytest.mark.parametrize(
    ("data", "name", "message"),
    [
        (ksplat(), "scene.ksplat", "a .ksplat scene.*splat-transform scene.ksplat scene.ply"),
    ],
)
def test_message_names_the_converter(tmp_path: Path, data: bytes, name: str, message: str) -> None:
    refused(tmp_path, data, message, name)
