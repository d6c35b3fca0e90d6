"""Estimate of the host memory that a job on GPUs needs, before its scene is read."""

from __future__ import annotations

#: Bytes of a Gaussian of SH degree 3 in memory: 62 float32 values.
GAUSSIAN_BYTES = 248
#: Bytes of a Gaussian in compressed files, by the ending of the file name. Compressed PLY has 16 bytes and one byte per
#: SH coefficient, .splat has 32 bytes, and SPZ has about 25 after entropy coding.
_PACKED_BYTES = ((".compressed.ply", 61), (".splat", 32), (".spz", 25))
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
    packed = next((each for suffix, each in _PACKED_BYTES if name.lower().endswith(suffix)), None)
    return size if packed is None else size * GAUSSIAN_BYTES // packed


def memory_beside_gpus(ranks: int, scene: int) -> int:
    """Estimate the host memory in bytes of `ranks` ranks on one machine with a scene of `scene` bytes."""
    return ranks * _RANK_BYTES + _SCENE_COPIES * scene
