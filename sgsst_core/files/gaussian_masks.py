"""Masks of a scene's Gaussians: one flag per row of the scene's file, as packed bits or as a NumPy array."""

from __future__ import annotations

import tokenize
from pathlib import Path

import numpy as np
import torch
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.errors import MaskError
from sgsst_core.files.advice import POINTER, refuse_known
from sgsst_core.files.scene_file import SceneFile

#: Suffix of masks of packed bits; every other file is read as .npy.
BITS_SUFFIX = ".bin"
#: Errors that NumPy raises for malformed headers, such as unclosed brackets, deep nesting and huge shapes.
_HEADER_ERRORS = (OSError, ValueError, TypeError, EOFError, OverflowError, MemoryError, tokenize.TokenError)


def read_mask(path: Path, file: SceneFile) -> Tensor:
    """Read a mask with one flag per row of the scene's file, and return the flags of the scene's Gaussians, [N] bool.

    A file that ends in .bin holds one bit per row: bit `i % 8` (1 is the lowest) of byte `i // 8` is the flag of row
    `i`, and unused bits of the last byte are 0. Other files are .npy arrays of the values 0 and 1.

    Raises:
        MaskError: If the file cannot be read, has another length, or has values other than 0 and 1.
    """
    try:
        refuse_known(path, [POINTER], MaskError)
    except OSError as error:
        raise MaskError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
    rows = len(file.scene) if file.retained is None else len(file.retained)
    read = _read_bits if path.suffix.lower() == BITS_SUFFIX else _read_npy
    flags = read(path, rows, file.path)
    return torch.from_numpy(np.array(flags if file.retained is None else flags[file.retained]))


def _read_bits(path: Path, rows: int, scene: Path) -> NDArray[np.bool_]:
    expected = (rows + 7) // 8
    with path.open("rb") as file:
        content = file.read(expected + 1)
    size = len(content) if len(content) <= expected else path.stat().st_size
    if size != expected:
        raise MaskError(
            f"{path}: has {size:,} bytes, but {scene} has {rows:,} Gaussians. "
            f"One bit for each makes {expected:,} bytes."
        )
    bits = np.unpackbits(np.frombuffer(content, np.uint8), bitorder="little")
    if bits[rows:].any():
        raise MaskError(f"{path}: has bits after that of the last of {rows:,} Gaussians. They must be 0.")
    return bits[:rows].astype(bool)


def _read_npy(path: Path, rows: int, scene: Path) -> NDArray[np.bool_]:
    try:
        values = open_memmap(path, mode="r")  # reads neither pickles nor archives, as np.load does
    except _HEADER_ERRORS as error:
        raise MaskError(f"{path}: cannot be read as .npy: {error}. Write it with numpy.save.") from error
    if values.dtype.kind not in "biuf":
        raise MaskError(f"{path}: does not hold an array of flags or numbers. Write it with numpy.save.")
    if values.shape != (rows,):
        raise MaskError(
            f"{path}: has the shape {values.shape}, but {scene} has {rows:,} Gaussians. It must be ({rows},)."
        )
    flags: NDArray[np.bool_] = values == 1
    if not bool((flags | (values == 0)).all()):
        raise MaskError(f"{path}: has values other than 0 and 1. Give a flag for each Gaussian.")
    return flags
