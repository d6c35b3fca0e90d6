"""Names of libraries that they may rename without notice: each is there, or a sentence says what to do.

Upper bounds in pyproject.toml keep such releases away; this says what to look at when a bound is raised.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("sgsst_core", "worker", "service", "api")


@dataclass(frozen=True)
class PrivateName:
    """A name that a library has not promised.

    Attributes:
        library: as pyproject.toml names it.
        module: that has it.
        name: of a function, class or class attribute, with dots.
        used_in: this project's module.
        gone: what to do where it is gone.
        check: whether it still is what is expected of it.
    """

    library: str
    module: str
    name: str
    used_in: str
    gone: str
    check: Callable[[Any], bool] = lambda found: True

    def found(self) -> Any:
        """What has that name, if it is as expected; None where it is not."""
        try:
            value = importlib.import_module(self.module)
            for part in self.name.split("."):
                value = getattr(value, part)
        except (ImportError, AttributeError):
            return None
        return value if self.check(value) else None


def takes(*names: str) -> Callable[[Any], bool]:
    """Whether a function has parameters of these names, or any."""

    def check(function: Any) -> bool:
        parameters = inspect.signature(function).parameters
        return all(name in parameters for name in names)

    return check


def source_has(*words: str) -> Callable[[Any], bool]:
    """Whether a library's source text names all of these, where nothing else can be asked."""
    return lambda found: all(word in inspect.getsource(found) for word in words)


def starts_with(*names: str) -> Callable[[Any], bool]:
    """Whether a function's first parameters have these names."""
    return lambda function: tuple(inspect.signature(function).parameters)[: len(names)] == names


HTTPTOOLS = "uvicorn.protocols.http.httptools_impl"
HEADS = (
    "see which method its protocol calls at that moment now, and override that one: otherwise a request's head may "
    "take for ever, or grow without end"
)
ANSWERS = (
    "see how its protocol names the connection and tells an answer under way from a finished one now: a refusal must "
    "not be written into an answer"
)

PRIVATE_NAMES = [
    PrivateName(
        "torch",
        "torch.distributed.distributed_c10d",
        "_set_pg_timeout",
        "worker/ranks/process_group.py",
        "see how a process group's time-out is changed after it was made (a public function would be welcome); without "
        "one, make the group anew with the shorter time-out once a job has been prepared",
        starts_with("timeout", "group"),
    ),
    PrivateName(
        "ray",
        "ray._private.worker",
        "print_to_stdstream",
        "worker/ranks/cluster.py",
        "look for what writes Ray's own errors to standard output now, and silence that in `_silence_ray`",
    ),
    PrivateName(
        "ray",
        "ray._private.worker",
        "init",
        "worker/ranks/cluster.py",
        "see how `ray.init` is told its folder and address now: ours must lie where its sockets' names fit and where "
        "the sweeper finds it, and it must listen on 127.0.0.1",
        source_has("_temp_dir", "_node_ip_address"),
    ),
    *(
        PrivateName("uvicorn", HTTPTOOLS, f"HttpToolsProtocol.{name}", "api/http/connection.py", HEADS)
        for name in (
            "connection_made",
            "connection_lost",
            "data_received",
            "on_headers_complete",
            "on_message_complete",
            "send_400_response",
        )
    ),
    PrivateName(
        "uvicorn",
        HTTPTOOLS,
        "HttpToolsProtocol.__init__",
        "api/http/connection.py",
        ANSWERS,
        source_has("self.cycle", "self.transport", "self.loop"),
    ),
    PrivateName(
        "uvicorn",
        HTTPTOOLS,
        "RequestResponseCycle.__init__",
        "api/http/connection.py",
        ANSWERS,
        source_has("self.response_started", "self.response_complete"),
    ),
]


@pytest.mark.parametrize("private", PRIVATE_NAMES, ids=lambda private: f"{private.library}:{private.name}")
def test_it_is_there(private: PrivateName) -> None:
    assert private.found() is not None, (
        f"{private.library} no longer has {private.module}.{private.name} as {private.used_in} uses it. "
        f"To go on with this release, {private.gone}. Until then, lower the bound of {private.library} in "
        "pyproject.toml."
    )


def test_every_private_module_and_argument_is_listed() -> None:
    """A private name that is imported, or given to `ray.init`, anywhere else has to be added above."""
    pattern = re.compile(
        r"^\s*(?:from|import) (?!sgsst_core|worker|service|api)\S*\._\w+"  # import ray._private.worker
        r"|^\s*from (?!sgsst_core|worker|service|api)\S+ import .*\b_\w+"  # from torch... import _set_pg_timeout
        r"|^\s+_(?:temp_dir|node_ip_address|system_config|metrics_export_port)=",
        re.MULTILINE,
    )
    users = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        if pattern.search(path.read_text())
    }
    assert users
    assert users <= {private.used_in for private in PRIVATE_NAMES}
