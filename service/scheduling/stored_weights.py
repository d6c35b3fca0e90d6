"""Weights of feature networks in the file store by digest, so that compute machines need not install them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from service.files.cache import file_digest
from service.files.objects import ObjectStore
from service.scheduling.workplace import StoredFile
from sgsst_core.files.cache_folder import cache_folder

_FOLDER = "weights"


def store_weights(objects: ObjectStore) -> dict[str, StoredFile]:
    """Upload this machine's installed weights unless they are stored already; return them by file name.

    Raises:
        StoreError: If the store cannot be reached.
    """
    found = {}
    for path in sorted(cache_folder().glob("*.safetensors")):
        status = path.stat()
        sha256 = _digest(path, status.st_size, status.st_mtime_ns)
        file = StoredFile(f"{_FOLDER}/{sha256}", sha256, status.st_size)
        if not objects.exists(file.name):
            objects.put(path, file.name)
        found[path.name] = file
    return found


@lru_cache
def _digest(path: Path, _size: int, _changed: int) -> str:
    return file_digest(path)
