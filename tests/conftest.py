"""Fixtures shared by all tests."""

import importlib.util
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # As in a shell's background jobs; tests send SIGINT to themselves and to processes that they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)

if not torch.cuda.is_available():
    # Read when Triton is first imported, by whichever test does so; kernels then run in its interpreter.
    os.environ.setdefault("TRITON_INTERPRET", "1")

from sgsst_core.errors import WeightsError
from sgsst_core.features.network_weights import BackboneWeights, fetch_network_weights, load_network_weights
from tests import networks, triton_interpreter
from tests.pretend_cuda.counts import Counts

if os.environ.get("TRITON_INTERPRET") == "1" and importlib.util.find_spec("triton"):
    triton_interpreter.prepare()


#: Start of this process in monotonic seconds, and seconds after which no slow test starts.
STARTED, LIMIT = time.monotonic(), float(os.environ.get("SGSST_TEST_SECONDS", "inf"))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip slow tests that come too late on a slow machine, where a run has a limit (`.ci/run`)."""
    if time.monotonic() - STARTED > LIMIT and item.get_closest_marker("slow"):
        pytest.skip(f"the {LIMIT:.0f} s of this run are over (SGSST_TEST_SECONDS)")


def pytest_make_parametrize_id(val: object) -> str | None:
    """Use the length of `bytes` parameters as test id, because their content (gzip times) may differ by process."""
    return f"{len(val)}-bytes" if isinstance(val, bytes) else None


DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder with real scenes, photos and paintings; tests that need it are skipped if it is missing."""
    if not DATA.is_dir():
        pytest.skip(f"no real scenes at {DATA}: see CONTRIBUTING.md, 'Real data'")
    return DATA


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Run PyTorch on one thread: for small views, waking a second thread takes longer than the work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def counts() -> Iterator[Counts]:
    """Simulate a GPU, and yield the counts of its launches, copies and waits."""
    from tests.pretend_cuda.runtime import pretend_cuda

    with pretend_cuda() as counts:
        yield counts


@pytest.fixture(scope="session")
def vgg16_weights() -> BackboneWeights:
    """Load the real VGG16 weights from the user's cache folder, which they are downloaded to if necessary."""
    try:
        fetch_network_weights("vgg16")
        return load_network_weights("vgg16")
    except WeightsError as error:
        pytest.fail(f"the tests need VGG16: {error}")


@pytest.fixture(scope="session")
def tiny_weights() -> BackboneWeights:
    """Return random weights of VGG16 with 16 channels per layer, for tests that compare two computations."""
    return networks.tiny_weights()


@pytest.fixture(scope="session")
def tiny_cache(vgg16_weights: BackboneWeights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache folder with the tiny network as vgg16, for `SGSST_CACHE`. Tests must not change it."""
    return networks.install_tiny_weights(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def tiny_installed(tiny_cache: Path) -> Iterator[Path]:
    """Make this process and its child processes use the tiny network as vgg16."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SGSST_CACHE", str(tiny_cache))
        yield tiny_cache
