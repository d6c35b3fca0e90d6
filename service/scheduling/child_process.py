"""Process of an attempt as seen by its dispatcher: start, reports, and termination."""

from __future__ import annotations

import contextlib
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from service.scheduling.endings import Report
from service.scheduling.packing import Grant

#: Variables that set a process' number of threads; values set by the operator take precedence.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class ChildProcess:
    """Running `service.scheduling.attempt_process`; it is started by the constructor.

    Args:
        cluster: Whether the attempt runs on a Ray cluster, which assigns GPUs itself.
    """

    def __init__(self, folder: Path, grant: Grant, *, cluster: bool) -> None:
        # a process without assigned GPUs must not see any
        environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "" if cluster else ",".join(grant.gpus)}
        if grant.threads is not None:
            environment = dict.fromkeys(_THREADS, str(grant.threads)) | environment
        with (folder / "log.txt").open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "service.scheduling.attempt_process", str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        self._reports: queue.Queue[Report | None] = queue.Queue()
        self._deadline: float | None = None
        self._finishing = False
        threading.Thread(target=self._listen, name=f"{folder.name}-out", daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                self._reports.put(Report.model_validate_json(line))
        self._reports.put(None)

    def receive(self, seconds: float) -> Report | None:
        """Return the next report; None if the process has closed its output.

        Raises:
            queue.Empty: If no report arrives within this time.
        """
        return self._reports.get(timeout=seconds)

    def finish(self) -> None:
        """Ask the process to end its job after the current step, with the present colors as the result.

        Call this only after the report `prepared`: earlier, the process may not handle the signal yet.
        """
        if not self._finishing:
            self._finishing = True
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGUSR1)

    def stop(self, patience: float) -> None:
        """Ask the process to stop; calls after `patience` seconds kill it."""
        if self._deadline is None:
            self._deadline = time.monotonic() + patience
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGTERM)
        elif time.monotonic() > self._deadline:
            self._deadline = math.inf
            self.kill()

    def kill(self) -> None:
        """Kill the process and all processes that it has started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def wait(self) -> int:
        """Wait for the process to exit, and return its exit code; negative for the signal that killed it."""
        return self._process.wait()
