"""Fixtures that every test package shares."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

if not torch.cuda.is_available():
    # Read when Triton is first imported, by whichever test that is: kernels then run in its interpreter.
    os.environ.setdefault("TRITON_INTERPRET", "1")

from sgsst_core.errors import WeightsError
from sgsst_core.features.network_weights import BackboneWeights, fetch_network_weights, load_network_weights
from tests import networks


def pytest_make_parametrize_id(val: object) -> str | None:
    """Bytes are named by their number: what is in them may hold the time (gzip) and differ between processes."""
    return f"{len(val)}-bytes" if isinstance(val, bytes) else None


DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with the real scenes, photos and paintings; tests that need it are skipped where it is not."""
    if not DATA.is_dir():
        pytest.skip(f"no real scenes at {DATA}: see CONTRIBUTING.md, 'Real data'")
    return DATA


@pytest.fixture
def one_thread() -> Iterator[None]:
    """For views so small that waking a second thread takes longer than the work, above all on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def vgg16_weights() -> BackboneWeights:
    """The real VGG16 from the user's cache folder, fetched into it once; a test that cannot get it fails."""
    try:
        fetch_network_weights("vgg16")
        return load_network_weights("vgg16")
    except WeightsError as error:
        pytest.fail(f"the tests need VGG16: {error}")


@pytest.fixture(scope="session")
def tiny_weights() -> BackboneWeights:
    """A network of VGG16's layers with 16 channels each: where one computation is compared with another one."""
    return networks.tiny_weights()


@pytest.fixture(scope="session")
def tiny_cache(vgg16_weights: BackboneWeights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder with the tiny network as vgg16, for `SGSST_CACHE` of other processes. Not to be changed."""
    return networks.install_tiny_weights(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def tiny_installed(tiny_cache: Path) -> Iterator[Path]:
    """The tiny network is what is installed: for the command in this process, and processes that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SGSST_CACHE", str(tiny_cache))
        yield tiny_cache
