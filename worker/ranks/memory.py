"""Estimates of the memory of ranks, from the size of their scene. Neither Ray nor PyTorch is imported."""

from __future__ import annotations

from sgsst_core.files.formats import format_of_name

#: Bytes of a Gaussian of SH degree 3 in memory: 62 float32 values.
GAUSSIAN_BYTES = 248
#: Bytes that a rank needs in addition to the scene: libraries of CUDA and PyTorch, and pinned buffers.
_RANK_BYTES = 3_000_000_000
#: Copies of the scene on a machine while it is loaded: the arrays read from the file, and the shared memory.
_SCENE_COPIES = 2


def scene_bytes(name: str, size: int) -> int:
    """Estimate the bytes of a scene in memory from its file.

    Args:
        name: Name of the file; its ending determines the format.
        size: Size of the file in bytes.
    """
    format = format_of_name(name)
    return size if format is None else size * GAUSSIAN_BYTES // format.bytes_per_gaussian


def memory_beside_gpus(ranks: int, scene: int) -> int:
    """Estimate the host memory in bytes of `ranks` ranks on one machine with a scene of `scene` bytes."""
    return ranks * _RANK_BYTES + _SCENE_COPIES * scene
