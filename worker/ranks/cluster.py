"""Ray for the time of some jobs: one of its own on this machine, or a cluster that is there already.

A Ray of its own listens on loopback, requires a secret token, and leaves nothing behind: neither when it is closed nor
when the process that started it is killed.
"""

from __future__ import annotations

import logging
import os
import secrets
import signal
import subprocess
import tempfile
import threading
from pathlib import Path
from types import TracebackType

import psutil

from sgsst_core.errors import ClusterAwayError, RanksFailedError
from worker.ranks import sweeper
from worker.ranks.failure_policy import first_line

#: Of Ray's object store: tensors travel through torch.distributed and scenes through files, so that next to nothing
#: lies there. Ray would take 30 % of all memory.
OBJECT_STORE_BYTES = 512 << 20
#: The longest folder for which the names of Ray's sockets fit what the system allows (107 bytes).
_LONGEST_FOLDER = 40
#: Of every Ray that this process starts: Ray reads it once.
_SECRET = secrets.token_hex(32)
#: Processes without which a Ray of one machine cannot go on.
_DAEMONS = ("raylet", "gcs_server")


class Cluster:
    """Ray, started or joined; a context manager that closes it.

    Ray ends with the thread that started it, so `open` belongs on the main thread of a process that lives on.

    Args:
        workers: most ranks that will be asked for at once.
        address: of a cluster; None for the environment's RAY_ADDRESS, and where there is none, a Ray of this machine.
    """

    def __init__(self, workers: int, address: str | None = None) -> None:
        self.address = address or os.environ.get("RAY_ADDRESS") or None
        self._workers = workers
        self._folder: Path | None = None
        self._sweeper: subprocess.Popen[bytes] | None = None
        self._daemons: list[psutil.Process] = []

    @property
    def local(self) -> bool:
        """Whether it is this machine's own."""
        return self.address is None

    def __enter__(self) -> Cluster:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self) -> None:
        """Start or join it.

        Raises:
            RanksFailedError: it cannot be started, or reached (ClusterAwayError).
        """
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError("Ray must be started on the main thread: it ends with the thread that started it")
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            if self.local:
                self._start()
            else:
                self._join()
        finally:
            for number, handler in before.items():  # Ray puts handlers of its own in their place
                signal.signal(number, handler)

    def _join(self) -> None:
        import ray

        _silence_ray()
        try:
            ray.init(address=self.address, log_to_driver=False, logging_level=logging.CRITICAL)
        except Exception as error:  # Ray has many for this, some of them plain ones
            raise ClusterAwayError(
                f"The Ray cluster at {self.address} cannot be reached: {first_line(error)}. Check RAY_ADDRESS, or "
                "leave it out for workers on this machine."
            ) from error

    def _start(self) -> None:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = _SECRET
        # Makes Ray bind all its ports to 127.0.0.1. Without it, Ray on Linux replaces that address by one that other
        # machines can reach. Ray reads the variable when it is imported.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_worker_niceness", "0")  # ranks are the work itself, not something beside it
        import ray

        _silence_ray()
        parent = tempfile.gettempdir()
        self._folder = Path(tempfile.mkdtemp(prefix="sgsst-ray-", dir=parent if len(parent) < 24 else "/tmp"))
        assert len(str(self._folder)) <= _LONGEST_FOLDER
        self._sweeper = sweeper.beside(self._folder, users=True)
        earlier = set(psutil.Process().children())
        try:
            ray.init(
                address="local",
                num_cpus=max(self._workers, os.cpu_count() or 1),
                object_store_memory=OBJECT_STORE_BYTES,
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.CRITICAL,
                _temp_dir=str(self._folder),
                _node_ip_address="127.0.0.1",
            )
        except BaseException as error:
            self.close()
            if not isinstance(error, Exception):
                raise
            raise RanksFailedError(
                f"Ray could not be started on this machine: {first_line(error)}. Run without --workers, or set "
                "RAY_ADDRESS to a cluster."
            ) from error
        started = [process for process in psutil.Process().children() if process not in earlier]
        self._daemons = [process for process in started if process.name() in _DAEMONS]

    def alive(self) -> bool:
        """Whether Ray's own processes on this machine run; of a cluster that was joined, nothing is known."""
        return all(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in self._daemons)

    def close(self) -> None:
        """Leave it; where it is this machine's own, end it with everything that runs in it."""
        import ray

        ray.shutdown()
        self._daemons = []
        if self._folder is not None:
            sweeper.sweep(self._folder)
            self._folder = None
        if self._sweeper is not None:
            sweeper.dismiss(self._sweeper)
            self._sweeper = None


def _silence_ray() -> None:
    """Keep Ray from printing what becomes of its processes: what matters is told in this program's words.

    `log_to_driver=False` silences the workers, but not Ray's own errors, which go to standard output by way of this
    function.
    """
    import ray._private.worker as worker

    worker.print_to_stdstream = lambda *arguments, **options: None
