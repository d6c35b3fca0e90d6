"""PostgreSQL server for tests and benchmarks, if PostgreSQL is installed."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import create_engine, text


def is_installed() -> bool:
    """Return whether the programs of PostgreSQL are installed."""
    return _programs() is not None


@contextmanager
def server(*, durable: bool = False) -> Iterator[str]:
    """Run a server within the block. Yields its URL without a database name.

    Args:
        durable: Whether commits are on disk before they are acknowledged, as is needed for realistic timing.
    """
    programs = _programs()
    assert programs is not None
    folder = Path(tempfile.mkdtemp(prefix="sgsst-pg-"))
    user: dict[str, Any] = {}
    if os.geteuid() == 0:  # PostgreSQL refuses to run as root
        shutil.chown(folder, "postgres")
        user = {"user": "postgres", "group": "postgres", "extra_groups": []}
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    data = str(folder / "data")
    options = {**user, "check": True, "stdout": subprocess.DEVNULL, "cwd": folder}
    subprocess.run([programs / "initdb", "-U", "sgsst", "-A", "trust", "-D", data], **options)
    started = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1 -c fsync={'on' if durable else 'off'}"
    subprocess.run([programs / "pg_ctl", "-D", data, "-o", started, "-l", folder / "log", "-w", "start"], **options)
    try:
        yield f"postgresql+psycopg://sgsst@127.0.0.1:{port}"
    finally:
        subprocess.run([programs / "pg_ctl", "-D", data, "-m", "immediate", "stop"], **options)
        shutil.rmtree(folder)


def fresh_database(url: str) -> str:
    """Create an empty database on a server and return its URL."""
    name = f"t{os.urandom(6).hex()}"
    engine = create_engine(f"{url}/postgres", isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    engine.dispose()
    return f"{url}/{name}"


def _programs() -> Path | None:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/pg_ctl"))
    on_path = shutil.which("pg_ctl")
    place = found[-1] if found else Path(on_path).resolve() if on_path else None
    return place.parent if place else None
