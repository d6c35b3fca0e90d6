"""Tests of masks with one flag per Gaussian: packed bits and NumPy arrays, valid and hostile ones."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sgsst_core.errors import MaskError
from sgsst_core.files.scene_file import SceneFile, read_scene
from sgsst_core.regions.selection import read_mask
from tests.small_scenes import LFS_POINTER, wall, write_files


@pytest.fixture
def file(tmp_path: Path) -> SceneFile:
    return read_scene(write_files(tmp_path, wall(5, 4))[0])


def npy(array: Any) -> bytes:
    content = io.BytesIO()
    np.save(content, array, allow_pickle=True)
    return content.getvalue()


def lying(shape: str, kind: str = "'|b1'") -> bytes:
    """Return a .npy file with 20 flags whose header declares this shape and type."""
    header = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(20)


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int64, np.float64])
def test_array_selects_its_rows(tmp_path: Path, file: SceneFile, kind: type) -> None:
    wanted = np.arange(20) % 3 == 0
    (tmp_path / "m.npy").write_bytes(npy(wanted.astype(kind)))
    assert read_mask(tmp_path / "m.npy", file).tolist() == wanted.tolist()


def test_lowest_bit_of_a_byte_is_its_first_gaussian(tmp_path: Path, file: SceneFile) -> None:
    (tmp_path / "m.BIN").write_bytes(bytes([0b00000011, 0b10000000, 0b00001000]))
    mask = read_mask(tmp_path / "m.BIN", file)
    assert mask.dtype == torch.bool
    assert mask.nonzero().flatten().tolist() == [0, 1, 15, 19]


@pytest.mark.parametrize("name", ["m.bin", "m.npy"])
def test_pointers_of_git_lfs_are_named(tmp_path: Path, file: SceneFile, name: str) -> None:
    (tmp_path / name).write_text(LFS_POINTER)
    with pytest.raises(MaskError, match=rf"{name}: is a pointer of Git LFS, not the file itself\. Run `git lfs pull`"):
        read_mask(tmp_path / name, file)


@pytest.mark.parametrize("rows", [1, 7, 8, 9, 20])
def test_bits_and_arrays_select_the_same(tmp_path: Path, rows: int) -> None:
    file = read_scene(write_files(tmp_path, wall(rows, 1))[0])
    wanted = np.random.default_rng(rows).random(rows) < 0.5
    (tmp_path / "m.npy").write_bytes(npy(wanted))
    (tmp_path / "m.bin").write_bytes(np.packbits(wanted, bitorder="little").tobytes())
    assert read_mask(tmp_path / "m.npy", file).tolist() == read_mask(tmp_path / "m.bin", file).tolist()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"has 0 bytes, but .* has 20 Gaussians. One bit for each makes 3 bytes"),
        (bytes(2), "has 2 bytes"),
        (bytes(1 << 20), "has 1,048,576 bytes"),
        (npy(np.zeros(20, bool)), "has 148 bytes"),
        (bytes([0, 0, 0b00010000]), "after that of the last of 20"),
        (b"\xff\xff\xff", "after that of the last of 20"),
        (None, "cannot be read: .*No such file"),
    ],
)
def test_invalid_bits_are_refused(tmp_path: Path, file: SceneFile, content: bytes | None, message: str) -> None:
    path = tmp_path / "m.bin"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MaskError, match=message):
        read_mask(path, file)


def test_folder_is_no_mask(tmp_path: Path, file: SceneFile) -> None:
    for name in ("m.bin", "m.npy"):
        (tmp_path / name).mkdir()
        with pytest.raises(MaskError, match="cannot be read"):
            read_mask(tmp_path / name, file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy(np.zeros(19)), r"has the shape \(19,\), but .* has 20 Gaussians"),
        (npy(np.zeros((20, 1))), r"has the shape \(20, 1\)"),
        (npy(np.full(20, 2)), "values other than 0 and 1"),
        (npy(np.full(20, np.nan)), "values other than 0 and 1"),
        (npy(np.array(["a"] * 20)), "does not hold an array of flags or numbers"),
        (npy(np.array([None] * 20)), "cannot be read as .npy"),
        (npy(np.zeros(20, [("a", "?")])), "does not hold an array of flags or numbers"),
        (lying("(99999999999,)"), "cannot be read as .npy"),
        (lying("(99999999999999999999999,)"), "cannot be read as .npy"),
        (lying("(-20,)"), "cannot be read as .npy"),
        (lying("(True,)"), "cannot be read as .npy"),
        (lying("()"), r"has the shape \(\)"),
        (lying("(" + "-" * 8000 + "20,)"), "cannot be read as .npy"),
        (lying("[" * 9000), "cannot be read as .npy"),
        (lying("(20,)", "'|O'"), "cannot be read as .npy"),
        (lying("(1,)", "('|b1', (20,))"), r"has the shape \(1, 20\)"),
        (lying("(2,)", "'<m8'"), "does not hold an array of flags or numbers"),
        (b"no npy at all", "cannot be read as .npy"),
        (b"PK\x03\x04", "cannot be read as .npy"),
        (b"\x93NUMPY\x01\x00\x02\x00{\n", "cannot be read as .npy"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{", "cannot be read as .npy"),
        (b"", "cannot be read as .npy"),
    ],
)
def test_invalid_arrays_are_refused(tmp_path: Path, file: SceneFile, content: bytes, message: str) -> None:
    (tmp_path / "m.npy").write_bytes(content)
    with pytest.raises(MaskError, match=message):
        read_mask(tmp_path / "m.npy", file)
