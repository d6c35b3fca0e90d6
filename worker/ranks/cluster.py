"""Context manager that starts a local Ray instance or joins an existing Ray cluster.

A local instance listens on loopback and requires a secret token. Its processes are ended and its files are deleted when
it is closed, and also when the process that started it is killed.
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

#: Size of Ray's object store in bytes. The default is 30 % of all memory, but the store holds almost nothing here:
#: torch.distributed exchanges tensors, and scenes are read from files.
OBJECT_STORE_BYTES = 512 << 20
#: Maximum length of the path of Ray's temporary folder. It keeps the paths of Ray's sockets within the system's limit
#: of 107 bytes.
_LONGEST_FOLDER = 40
#: Token of every Ray instance that this process starts. Ray reads the token only once.
_SECRET = secrets.token_hex(32)
#: Ray processes without which a local instance does not work.
_DAEMONS = ("raylet", "gcs_server")


class Cluster:
    """Ray instance or cluster, as a context manager.

    Ray ends with the thread that started it, so `open` must be called on the main thread.

    Args:
        workers: Maximum number of ranks that run at once.
        address: Address of a Ray cluster; None for the environment variable RAY_ADDRESS. If neither is given, a local
            instance is started.
    """

    def __init__(self, workers: int, address: str | None = None) -> None:
        self.address = address or os.environ.get("RAY_ADDRESS") or None
        self._workers = workers
        self._folder: Path | None = None
        self._sweeper: subprocess.Popen[bytes] | None = None
        self._daemons: list[psutil.Process] = []

    @property
    def local(self) -> bool:
        """Return whether this is a local instance rather than a cluster."""
        return self.address is None

    def __enter__(self) -> Cluster:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self) -> None:
        """Start the local instance or join the cluster.

        Raises:
            RanksFailedError: If the local instance cannot be started.
            ClusterAwayError: If the cluster cannot be joined.
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
            for number, handler in before.items():  # restore the handlers that Ray has replaced
                signal.signal(number, handler)

    def _join(self) -> None:
        import ray

        _silence_ray()
        try:
            ray.init(address=self.address, log_to_driver=False, logging_level=logging.CRITICAL)
        except Exception as error:  # Ray raises errors of many types here, some of them built-in
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
        os.environ.setdefault("RAY_worker_niceness", "0")  # run ranks at normal priority
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
        """Return whether the daemons of a local instance run. Always True for a cluster, which is not checked."""
        return all(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in self._daemons)

    def close(self) -> None:
        """Disconnect from Ray; end a local instance and all its processes."""
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
    """Keep Ray from printing errors of its processes, since this program reports them itself.

    `log_to_driver=False` silences the workers, but not Ray's own errors. Ray prints those with the function that is
    replaced here.
    """
    import ray._private.worker as worker

    worker.print_to_stdstream = lambda *arguments, **options: None
