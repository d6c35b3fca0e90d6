"""Detection of pointers of Git LFS, which lie in place of files that were not downloaded. PyTorch is not imported."""

from __future__ import annotations

from pathlib import Path

from sgsst_core.errors import InvalidInputError

_START = b"version https://git-lfs"
#: Text about such a file, after its path and "is".
POINTER = "a pointer of Git LFS, not the file itself. Run `git lfs pull`"


def is_pointer(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a pointer."""
    return head.startswith(_START)


def refuse_pointer(path: Path, error: type[InvalidInputError]) -> None:
    """Raise an error of a type if a file is a pointer.

    Raises:
        InvalidInputError: If it is one, of the given type.
        OSError: If the file cannot be read.
    """
    with path.open("rb") as file:
        if is_pointer(file.read(len(_START))):
            raise error(f"{path}: is {POINTER}.")
