"""PostgreSQL server for tests and benchmarks, if PostgreSQL is installed."""

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from sqlalchemy import create_engine, text

from tests.ports import free_port


def is_installed() -> bool:
    """Return whether the programs of PostgreSQL are installed."""
    return programs_folder() is not None


class Postgres:
    """PostgreSQL server that tests can stop, kill and restart.

    Attributes:
        url: URL of the server, without a database name.
    """

    def __init__(self, *, durable: bool) -> None:
        programs = programs_folder()
        assert programs is not None
        self._programs = programs
        self._folder = Path(tempfile.mkdtemp(prefix="sgsst-pg-"))
        user: dict[str, Any] = {}
        if os.geteuid() == 0:  # it refuses to run as root
            shutil.chown(self._folder, "postgres")
            user = {"user": "postgres", "group": "postgres", "extra_groups": []}
        port = free_port()
        self.url = f"postgresql+psycopg://sgsst@127.0.0.1:{port}"
        self._options: dict[str, Any] = {**user, "check": True, "stdout": subprocess.DEVNULL, "cwd": self._folder}
        self._data = str(self._folder / "data")
        subprocess.run([programs / "initdb", "-U", "sgsst", "-A", "trust", "-D", self._data], **self._options)
        fsync = "on" if durable else "off"
        self._started = f"-p {port} -k {self._folder} -c listen_addresses=127.0.0.1 -c fsync={fsync}"

    def start(self) -> None:
        """Start the server, and wait until it accepts connections."""
        self._control("-o", self._started, "-l", str(self._folder / "log"), "-w", "start")

    @contextmanager
    def standby(self) -> Iterator[None]:
        """Restart the server as a standby, as a failover does, and promote it after the block."""
        self._control("-m", "fast", "-w", "stop")
        (Path(self._data) / "standby.signal").touch()
        self.start()
        try:
            yield
        finally:
            self._control("-w", "promote")

    def signal(self, number: int) -> None:
        """Send a signal to all processes of the server."""
        main = psutil.Process(int((Path(self._data) / "postmaster.pid").read_text().split()[0]))
        processes = [main, *main.children(recursive=True)]
        for process in processes:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.send_signal(number)
        if number == signal.SIGKILL:  # a server cannot start while a process of the killed one holds its memory
            psutil.wait_procs(processes, timeout=60)

    def remove(self) -> None:
        """Stop the server, and delete its folder."""
        self._control("-m", "immediate", "stop")
        shutil.rmtree(self._folder)

    def _control(self, *arguments: str) -> None:
        subprocess.run([self._programs / "pg_ctl", "-D", self._data, *arguments], **self._options)


@contextmanager
def controlled_server(*, durable: bool = False) -> Iterator[Postgres]:
    """Run a server within the block, and yield it.

    Args:
        durable: Whether commits are written to disk before they are acknowledged, as realistic timing requires.
    """
    started = Postgres(durable=durable)
    started.start()
    try:
        yield started
    finally:
        started.remove()


@contextmanager
def server(*, durable: bool = False) -> Iterator[str]:
    """Run a server within the block, and yield its URL, without a database name."""
    with controlled_server(durable=durable) as started:
        yield started.url


def fresh_database(url: str, template: str = "template1") -> str:
    """Create a database on a server, empty or as a copy of another, and return the database's URL."""
    name = f"t{os.urandom(6).hex()}"
    engine = create_engine(f"{url}/postgres", isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name} TEMPLATE {template}"))
    engine.dispose()
    return f"{url}/{name}"


def programs_folder() -> Path | None:
    """Return the folder of PostgreSQL's programs, or None if it is not installed."""
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin/pg_ctl"))
    on_path = shutil.which("pg_ctl")
    place = programs[-1] if programs else Path(on_path).resolve() if on_path else None
    return place.parent if place else None
