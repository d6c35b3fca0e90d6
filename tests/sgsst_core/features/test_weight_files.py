"""Tests of weight files: each flipped bit is detected, and files of the package match digests in the code."""

from __future__ import annotations

import io
import os
import shutil
from pathlib import Path

import pytest
import safetensors
import safetensors.torch
import torch

from sgsst_core.errors import WeightsError
from sgsst_core.features import network_weights
from sgsst_core.features.network_weights import BackboneWeights, cache_folder, fetch_network_weights
from sgsst_core.features.weight_files import (
    PACKAGE_DIGEST,
    PACKAGE_FILES,
    PACKAGE_SOURCE,
    damaged_weights,
    digest_of_bytes,
    verify,
)


@pytest.fixture
def folder(vgg16_weights: BackboneWeights, tmp_path: Path) -> Path:
    """Return a folder with a copy of the package's smaller weight file, which a test may damage."""
    shutil.copy(cache_folder() / "lpips_alex.safetensors", tmp_path)
    return tmp_path


def flip(path: Path, position: int, bit: int = 0) -> None:
    """Flip one bit of a file without changing its times."""
    status = path.stat()
    content = bytearray(path.read_bytes())
    content[position] ^= 1 << bit
    path.write_bytes(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


@pytest.mark.parametrize("name", PACKAGE_FILES)
def test_package_files_match_digests_in_the_code(name: str, vgg16_weights: BackboneWeights) -> None:
    with (cache_folder() / f"{name}.safetensors").open("rb") as stream:
        metadata = verify(stream, name, name)
    assert metadata["source"] == PACKAGE_SOURCE
    assert metadata["source_sha256"] == PACKAGE_DIGEST
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
    metadata["sha256"] = digest_of_bytes(safetensors.torch.save(tensors, metadata))
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
        flip(path, path.stat().st_size // 2)
        path.touch()
    damaged = damaged_weights(folder)
    assert len(damaged) == 2
    for name, damage in zip(("vgg16", "lpips_alex"), damaged, strict=True):
        assert damage.startswith(f"{folder / name}.safetensors")
        assert "sgsst weights fetch vgg16" in damage
        assert "--from FILE" in damage


def test_replaced_file_is_verified_again(folder: Path, vgg16_weights: BackboneWeights) -> None:
    path = folder / "lpips_alex.safetensors"
    flip(path, -1)
    path.touch()
    assert damaged_weights(folder)
    shutil.copy(cache_folder() / "lpips_alex.safetensors", path)
    assert damaged_weights(folder) == []
    assert damaged_weights(folder / "empty") == []


def test_fetch_replaces_damaged_weights_from_a_file(tiny_cache: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(tiny_cache / "vgg16.safetensors", tmp_path))
    flip(path, -1, 7)
    assert damaged_weights(tmp_path)
    fetch_network_weights("vgg16", source=tiny_cache / "narrow.pth", folder=tmp_path)
    assert damaged_weights(tmp_path) == []
