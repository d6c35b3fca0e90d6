"""Ray instance or cluster of a job, and the cores, GPUs and memory that it reserves there for the ranks.

A local instance listens on loopback and requires a secret token. Its processes are ended and its files are deleted when
it is closed, and also when the process that started it is killed.

Estimates of the memory of ranks, from the size of their scene. Neither Ray nor PyTorch is imported.
"""

import contextlib
import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil

from sgsst_core import container
from sgsst_core.errors import ClusterAwayError, RanksFailedError, SettingsError
from worker.job import memory_beside_gpus
from worker.processes import HANGUP, STOP_SIGNALS, dismiss_sweeper, start_sweeper, sweep

#: Size of Ray's object store in bytes. The default is 30 % of all memory, but the store holds almost nothing here:
#: torch.distributed exchanges tensors, and scenes are read from files.
OBJECT_STORE_BYTES = 512 << 20
#: Token of every Ray instance that this process starts. Ray reads the token only once.
_SECRET = secrets.token_hex(32)
#: Seconds in which a cluster must accept a connection.
_ANSWER_SECONDS = 10.0
#: Ray processes without which a local instance does not work.
_DAEMONS = ("raylet", "gcs_server")


class Cluster:
    """Ray instance or cluster, as a context manager.

    Ray ends with the thread that started it, so `open` must be called on the main thread; on others, Python's `signal`
    raises an error.

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

    def __enter__(self) -> "Cluster":
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
            SettingsError: If no local instance can be started on this system.
            ClusterAwayError: If the cluster cannot be joined.
        """
        before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
        try:
            if HANGUP is not None:  # Ray's processes inherit this: they must outlast a closed terminal
                signal.signal(HANGUP, signal.SIG_IGN)
            with contextlib.chdir("/"):  # Ray lets its processes import modules from the current folder
                if self.address is None:
                    self._start()
                else:
                    self._join(self.address)
        finally:
            for number, handler in before.items():  # restore the handlers that Ray has replaced
                signal.signal(number, handler)

    def _join(self, address: str) -> None:
        import ray

        _silence_ray()
        try:
            _check_answers(address)
            ray.init(address=address, log_to_driver=False, logging_level=logging.CRITICAL)
        except Exception as error:  # Ray raises errors of many types here, some of them built-in
            raise ClusterAwayError(
                f"The Ray cluster at {address} cannot be reached: {first_line(error)}. Check RAY_ADDRESS, or "
                "leave it out for workers on this machine."
            ) from error

    def _start(self) -> None:
        if sys.platform == "win32":  # under Wine, Ray's processes do not start; it was not tried on Windows itself
            raise SettingsError(
                "--workers requires Linux or macOS. Omit it, or run the command in WSL2 (`wsl --install`)."
            )
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = _SECRET
        # Makes Ray bind all its ports to 127.0.0.1. Without it, Ray on Linux replaces that address by one that other
        # machines can reach. Ray reads the variable when it is imported.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_worker_niceness", "0")  # run ranks at normal priority
        import ray

        _silence_ray()
        # Paths of Ray's sockets may have 107 bytes, which those in a folder for temporary files could exceed.
        self._folder = Path(tempfile.mkdtemp(prefix="sgsst-ray-", dir="/tmp"))
        self._sweeper = start_sweeper(self._folder)
        try:
            ray.init(
                address="local",
                num_cpus=max(self._workers, container.cores()),
                object_store_memory=OBJECT_STORE_BYTES,
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.CRITICAL,
                _temp_dir=str(self._folder),
                _node_ip_address="127.0.0.1",
            )
        except Exception as error:
            self.close()
            raise RanksFailedError(
                f"Ray could not be started on this machine: {first_line(error)}. Run without --workers, or set "
                "RAY_ADDRESS to a cluster."
            ) from error
        daemons = [each for each in psutil.process_iter(["name", "ppid"]) if each.info["name"] in _DAEMONS]
        self._daemons = [each for each in daemons if each.info["ppid"] == os.getpid() and _is_running(each)]

    def alive(self) -> bool:
        """Return whether the daemons of a local instance run. Always True for a cluster, which is not checked."""
        return all(map(_is_running, self._daemons))

    def close(self) -> None:
        """Disconnect from Ray; end a local instance and all its processes."""
        import ray

        ray.shutdown()
        self._daemons = []
        if self._folder is not None:
            sweep(self._folder)
            self._folder = None
        if self._sweeper is not None:
            dismiss_sweeper(self._sweeper)
            self._sweeper = None


def _check_answers(address: str) -> None:
    """Raise an OSError if nothing listens at HOST:PORT. Ray itself would wait for minutes."""
    host, _, port = address.rpartition("//")[2].rpartition(":")
    if port.isdecimal():  # else "auto", which Ray looks up
        socket.create_connection((host.strip("[]"), int(port)), _ANSWER_SECONDS).close()


def _is_running(process: psutil.Process) -> bool:
    """Return whether a process has not ended."""
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def _silence_ray() -> None:
    """Keep Ray from printing errors of its processes, since this program reports them itself.

    `log_to_driver=False` silences the workers, but not Ray's own errors. Ray prints those with the function that is
    replaced here.
    """
    import ray._private.worker as worker

    worker.print_to_stdstream = lambda *arguments, **options: None


#: Seconds to wait for resources in use. Those of lost ranks are soon free again.
PLACE_SECONDS = 5
#: Seconds after which the number of ranks to reserve resources for is reduced by an eighth instead of one.
_SHORTEN_SECONDS = 10


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message without its full stop, or the error's type if it has no message."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


class NoCapacityError(Exception):
    """Error if the cluster has no free resources even for one rank."""


@dataclass(frozen=True)
class Reservation:
    """Resources for ranks.

    Attributes:
        group: Ray placement group with a bundle for each rank.
        ranks: Number of ranks.
        threads: Processor cores per rank.
        gpus: GPUs per rank, 0 or 1.
    """

    group: Any
    ranks: int
    threads: int
    gpus: int

    def actor_options(self, rank: int) -> dict[str, Any]:
        """Return the options of a rank's actor. Ray must not restart an actor that died."""
        from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

        return {
            "num_cpus": self.threads,
            "num_gpus": self.gpus,
            "max_restarts": 0,
            "max_task_retries": 0,
            "max_concurrency": 2,
            "scheduling_strategy": PlacementGroupSchedulingStrategy(self.group, placement_group_bundle_index=rank),
        }

    def release(self) -> None:
        """Release all resources."""
        from ray.util import remove_placement_group

        remove_placement_group(self.group)


def reserve(workers: int, scene: int = 0) -> Reservation:
    """Reserve resources for as many ranks as the cluster can run now.

    If the cluster has GPUs, every rank gets one, together with the host memory that it needs, on as few machines as
    possible. Otherwise ranks are spread over the machines, and the cores are divided among them.

    Args:
        workers: Maximum number of ranks.
        scene: Bytes of the job's scene in memory.

    Raises:
        NoCapacityError: If there are no free resources even for one rank.
    """
    import ray
    from ray.util import placement_group

    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    gpus = sum(int(node.get("GPU", 0)) for node in nodes)
    wanted = min(workers, gpus) if gpus else workers
    cores = [int(node.get("CPU", 0)) for node in nodes]
    threads = _threads(cores, wanted)
    wanted = min(wanted, sum(count // threads for count in cores))
    # A job that needs more memory than any machine has gets all of the largest machine's, and may still succeed there.
    most = max((int(node.get("memory", 0)) for node in nodes if node.get("GPU")), default=0)
    of_gpu = {"GPU": 1, "memory": min(memory_beside_gpus(1, scene), most)} if gpus else {}
    patience, deadline = PLACE_SECONDS, time.monotonic() + _SHORTEN_SECONDS
    while wanted > 0:
        group = placement_group([{"CPU": threads, **of_gpu}] * wanted, strategy="PACK" if gpus else "SPREAD")
        reservation = Reservation(group, wanted, threads, 1 if gpus else 0)
        if group.wait(patience):
            return reservation
        reservation.release()
        if threads > 1 and not gpus:  # other jobs may use some of the cores
            threads = 1
        else:
            wanted -= 1 if time.monotonic() < deadline else max(wanted // 8, 1)
        patience = max(int(deadline - time.monotonic()) // max(wanted, 1), 2)  # Ray ignores fractions of a second
    needed = ", ".join(f"{name} {amount:,}" for name, amount in {"CPU": threads, **of_gpu}.items())
    raise NoCapacityError(f"Ray has no capacity for a worker, which needs {needed}")


def _threads(cores: list[int], ranks: int) -> int:
    """Return the largest number of cores that each of `ranks` ranks can have on these machines; at least one."""
    return max(
        (each for each in range(1, max(cores, default=1) + 1) if sum(count // each for count in cores) >= ranks),
        default=1,
    )
