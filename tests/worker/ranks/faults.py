"""Fault injection in ranks: real signals to real processes, at reproducible points of the program."""

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import psutil

from sgsst_core.settings import make_settings
from tests.full_disk import full_disk
from tests.small_scenes import wall, write_files
from worker.job import JobSpec, SceneRequest
from worker.options import StyleFile
from worker.run import OpenWorkplace, RankProcess, RankTask

Place = Literal["all_reduce", "checkpoint", "render"]


@dataclass(frozen=True)
class Fault:
    """Fault of a rank, which occurs once.

    Attributes:
        rank: Rank at which the fault occurs.
        place: Name of the function during which the fault occurs.
        call: Index of the function call during which the fault occurs, counted from 1.
        what: Name of the signal that is sent to the rank, or "full" for a full disk.
        delay: Seconds from the start of the call to the signal.
    """

    rank: int
    place: Place
    call: int
    what: Literal["SIGKILL", "SIGSTOP", "full"]
    delay: float = 0.0

    def write(self, request: JobSpec) -> None:
        """Write the fault to the file that `FaultyRank` reads."""
        _file(request).parent.mkdir(parents=True, exist_ok=True)
        _file(request).write_text(json.dumps(asdict(self)))

    def arm(self, request: JobSpec) -> None:
        """Install the fault in this process once the job is planned."""
        from sgsst_core.stylizing.stylizer import Stylizer

        create: Callable[..., None] = Stylizer.__init__

        def create_and_install(stylizer: Stylizer, *arguments: Any, **options: Any) -> None:
            create(stylizer, *arguments, **options)
            setattr(Stylizer, "__init__", create)  # noqa: B010 (it is a method)
            self._install(request)

        setattr(Stylizer, "__init__", create_and_install)  # noqa: B010 (it is a method)

    def _install(self, request: JobSpec) -> None:
        owner, name = _places()[self.place]
        original: Callable[..., Any] = getattr(owner, name)
        calls = 0

        def wrapped(*arguments: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls != self.call:
                return original(*arguments, **options)
            _file(request).rename(_fired(request))  # the fault must not occur in the next attempt
            os.utime(_fired(request))  # record the current time, which a renamed file does not have
            if self.what == "full":
                with full_disk(4096):
                    return original(*arguments, **options)
            threading.Thread(target=self._signal, daemon=True).start()
            time.sleep(0)
            return original(*arguments, **options)

        setattr(owner, name, wrapped)

    def _signal(self) -> None:
        time.sleep(self.delay)
        os.kill(os.getpid(), getattr(signal, self.what))


class FaultyRank(RankProcess):
    """Rank that injects the fault that is stored beside the job's output."""

    def _work(self, task: RankTask, place: OpenWorkplace | None) -> None:
        if _file(task.request).exists():
            fault = Fault(**json.loads(_file(task.request).read_text()))
            if fault.rank == task.rank:
                fault.arm(task.request)
        super()._work(task, place)


def fired(request: JobSpec) -> float | None:
    """Return the time of the fault in seconds since the epoch; None if it has not occurred."""
    path = _fired(request)
    return path.stat().st_mtime if path.exists() else None


def small_request(folder: Path, steps: int, **settings: Any) -> JobSpec:
    """Write the inputs of a job with tiny views that uses all ranks, and return its request."""
    inputs = folder / "inputs"
    inputs.mkdir(parents=True, exist_ok=True)
    ply, cameras, style = write_files(inputs, wall())
    options = {"steps_sos": steps, "early_stop": False, **settings}
    source = SceneRequest(scene=ply, cameras=cameras)
    chosen, out = make_settings(**options), folder / "out" / "s.ply"
    return JobSpec(source=source, styles=(StyleFile(style),), out=out, settings=chosen, backbone="vgg16")


def name_of(process: psutil.Process) -> str:
    """Return the name of a process; an empty string if it has ended since it was listed."""
    try:
        return process.name()
    except psutil.Error:
        return ""


def shared_memory(processes: Iterable[psutil.Process]) -> set[Path]:
    """Return the shared memory files that these processes have mapped."""
    segments = set()
    for process in processes:
        with contextlib.suppress(psutil.Error):
            segments |= {Path(entry.path) for entry in process.memory_maps() if entry.path.startswith("/dev/shm/")}
    return segments


def folders(processes: Iterable[psutil.Process]) -> set[Path]:
    """Return Ray's folders in the command lines of these processes."""
    words = []
    for process in processes:
        with contextlib.suppress(psutil.Error):
            words += process.cmdline()
    return {Path("/", *Path(word).parts[1:3]) for word in words if word.startswith("/tmp/sgsst-ray-")}


def _file(request: JobSpec) -> Path:
    return request.out.with_suffix(".fault")


def _fired(request: JobSpec) -> Path:
    return request.out.with_suffix(".fired")


def _places() -> dict[Place, tuple[Any, str]]:
    from sgsst_core.stylizing.views import Views
    from worker import execute
    from worker.ranks.process_group import ProcessGroupCollectives

    return {
        "all_reduce": (ProcessGroupCollectives, "all_reduce"),
        "checkpoint": (execute, "save_checkpoint"),
        "render": (Views, "render"),
    }
