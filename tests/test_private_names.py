"""Tests that the private names of dependencies that the project uses still exist.

The upper bounds of Ray and uvicorn in pyproject.toml exclude a new version until these tests pass with it.
"""

import importlib.util
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
OWN = r"(?!sgsst_core|worker|service|api)"
#: Private modules and functions that are imported, and private options of calls.
PRIVATE = re.compile(
    rf"^\s*(?:from|import) {OWN}\S*\._\w+|^\s*from {OWN}\S+ import .*\b_\w+|^\s+_[a-z_]+=", re.MULTILINE
)


def test_only_listed_modules_use_private_names() -> None:
    files = [path for package in ("sgsst_core", "worker", "service", "api") for path in (ROOT / package).rglob("*.py")]
    users = {path.relative_to(ROOT).as_posix() for path in files if PRIVATE.search(path.read_text())}
    assert users == {"worker/ranks/cluster.py"}, (
        "Another module uses a private name of a package. Do without it, or add a test of the name here that says what "
        "to do when it is gone, and bound the package in pyproject.toml."
    )


def source(package: str, file: str) -> str:
    """Return a file of a package that is not imported: Ray reads its authentication mode at import."""
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.origin is not None
    return (Path(spec.origin).parent / file).read_text()


WORKER, HTTPTOOLS = ("ray", "_private/worker.py"), ("uvicorn", "protocols/http/httptools_impl.py")
FOLDER = (
    "Find what took its place, and change worker/ranks/cluster.py: without a folder of its own, what a killed Ray "
    "leaves behind cannot be swept away; without 127.0.0.1, Ray listens on the network."
)
LOOPBACK = (
    "Find what keeps Ray from replacing 127.0.0.1 by an address that others reach, and change worker/ranks/cluster.py; "
    "tests/worker/ranks/test_sockets.py lists the sockets."
)
PRINTS = (
    "Ray's driver prints the errors of its processes by another function now. Find what writes them to standard "
    "output, and replace that one in worker/ranks/cluster.py."
)
ANSWER = "Find how api/http/server.py can tell whether an answer is open."
STATE = "Find what api/http/server.py can read instead."


@pytest.mark.parametrize(
    ("where", "text", "remedy"),
    [
        (WORKER, "\ndef print_to_stdstream(", PRINTS),
        (WORKER, '"_temp_dir"', FOLDER),
        (WORKER, '"_node_ip_address"', FOLDER),
        (("ray", "_private/ray_constants.py"), '"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"', LOOPBACK),
        (("ray", "_private/services.py"), "ENABLE_RAY_CLUSTER", LOOPBACK),
        *((HTTPTOOLS, f" self.{name}", STATE) for name in ("loop", "transport", "flow", "connections", "pipeline")),
        *((HTTPTOOLS, f" self.{name}", STATE) for name in ("scope", "headers", "cycle")),
        *((HTTPTOOLS, f" self.{name}", ANSWER) for name in ("body", "response_started", "response_complete")),
    ],
)
def test_names_in_sources_exist(where: tuple[str, str], text: str, remedy: str) -> None:
    assert text in source(*where), f"{'/'.join(where)} has no {text.strip()} any more. {remedy}"


def test_numba_cache_save_method_is_replaceable() -> None:
    import numba.core.caching

    assert list(inspect.signature(numba.core.caching.Cache.save_overload).parameters) == ["self", "sig", "data"], (
        "Numba saves kernels by another method now. Find it, and replace it in sgsst_core/compiled.py: "
        "a confined process cannot write them, and every dry run that has to compile one would break."
    )


def test_names_of_pytorch_exist() -> None:
    import torch.distributed as dist

    store: Any = dist.TCPStore  # type: ignore[attr-defined]
    assert "master_listen_fd" in (store.__init__.__doc__ or ""), (
        "PyTorch's store no longer takes a socket that listens already. Find how it can be bound to one address, and "
        "change `_meet` in worker/ranks/process_group.py; else it listens on every interface, without "
        "authentication."
    )


@pytest.mark.parametrize(
    "method",
    [
        "connection_made",
        "connection_lost",
        "data_received",
        "on_message_begin",
        "on_header",
        "on_headers_complete",
        "on_body",
        "on_message_complete",
        "on_response_complete",
        "send_400_response",
    ],
)
def test_overridden_connection_methods_exist(method: str) -> None:
    from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

    from api.http.server import Connection

    assert method in vars(Connection)
    assert method in vars(HttpToolsProtocol), (
        f"uvicorn's HTTP protocol has no {method} any more: api/http/server.py overrides nothing there. Find what "
        "it is called now; tests/api/http/hostile shows whether heads are bounded again."
    )
