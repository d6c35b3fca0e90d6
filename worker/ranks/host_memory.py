"""Memory of its machine that a job on GPUs takes beside these: an estimate, before anybody has read its scene."""

from __future__ import annotations

#: Bytes of a Gaussian as it is read: 62 float32, of SH degree 3.
GAUSSIAN_BYTES = 248
#: The same in the other forms of scene files by their names' ending, the longest first: chunks of 16 bytes and SH in
#: bytes; a .splat's 32; SPZ is zipped besides.
_PACKED_BYTES = ((".compressed.ply", 61), (".splat", 32), (".spz", 25))
#: What a rank takes beside the scene (CUDA's and PyTorch's libraries, pinned buffers), and how often the bytes of the
#: scene: as it was read, and as it is laid out for all ranks of a machine.
_RANK_BYTES = 3_000_000_000
_SCENE_COPIES = 2


def scene_bytes(name: str, size: int) -> int:
    """Bytes of a scene once it is read, by its file.

    Args:
        name: of the file; its ending tells the form.
        size: of the file, bytes.
    """
    packed = next((each for suffix, each in _PACKED_BYTES if name.lower().endswith(suffix)), None)
    return size if packed is None else size * GAUSSIAN_BYTES // packed


def memory_beside_gpus(ranks: int, scene: int) -> int:
    """Bytes that so many ranks on one machine take of it, with one scene of so many bytes."""
    return ranks * _RANK_BYTES + _SCENE_COPIES * scene
