"""Examination of a machine: what works, what is slow, and what does not work, in plain words.

    python -m sgsst_core.bench.doctor

prints one finding per line as JSON, as soon as it is known.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import torch

State = Literal["works", "warning", "problem"]
#: Seconds after which a check is cut off.
LIMIT = 27.0
#: Seconds after which a query of `nvidia-smi` counts as failed.
_TIMEOUT = 10
#: Gigabytes of memory budget below which only small scenes fit.
_LITTLE_MEMORY = 2.0


@dataclass(frozen=True)
class Diagnosis:
    """Finding about one topic.

    Attributes:
        state: "works"; "warning" if jobs run, but slower than they could; "problem" if they fail or are wrong.
        text: Description, and for other states than "works", what to do.
    """

    topic: str
    state: State
    text: str


def examine(limit: float = LIMIT) -> Iterator[Diagnosis]:
    """Yield findings about this machine, as a separate process makes them.

    The process is killed if it has neither a finding nor a newly compiled kernel within `limit` seconds. A GPU that
    hangs or a driver that crashes therefore becomes a finding.
    """
    late = threading.Event()
    command = [sys.executable, "-P", "-m", "sgsst_core.bench.doctor"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:

        def kill() -> None:
            late.set()
            process.kill()

        def watch() -> threading.Timer:
            timer = threading.Timer(limit, kill)
            timer.start()
            return timer

        timer = watch()
        errors: list[str] = []
        reader = threading.Thread(target=lambda: errors.append(process.stderr.read() if process.stderr else ""))
        reader.start()
        try:
            for line in process.stdout or ():
                timer.cancel()
                timer = watch()
                if line.strip():
                    yield Diagnosis(**json.loads(line))
            status = process.wait()
        finally:
            timer.cancel()
            process.kill()
            reader.join()
    if status and late.is_set():
        text = f"a check took more than {limit:.0f} seconds. Run the command again: what was compiled is cached."
        yield Diagnosis("time", "warning", text)
    elif status:
        last = (errors[0].strip().splitlines() or ["no message"])[-1]
        yield Diagnosis("program", "problem", f"the examination ended with status {status}: {last}")


def findings() -> Iterator[Diagnosis]:
    """Yield findings about this machine, made in this process."""
    yield _weights()
    yield from _caches()
    import torch

    versions = f"Python {sys.version.split()[0]}, PyTorch {torch.__version__}, Triton {package_version('triton')}"
    yield Diagnosis("program", "works", versions)
    yield _gpu()
    gpu = torch.cuda.is_available()
    device = torch.device("cuda", torch.cuda.current_device()) if gpu else torch.device("cpu")
    yield _memory(device)
    rasterizer, finding = _rasterizer(gpu=gpu)
    yield finding
    yield _precision()
    yield from _results(rasterizer, device)
    yield _kernels()


def _weights() -> Diagnosis:
    from sgsst_core.features.network_weights import list_network_weights
    from sgsst_core.features.weight_files import damage_of

    installed = [entry for entry in list_network_weights() if entry.path is not None]
    for entry in installed:
        if entry.path is not None and (damage := damage_of(entry.path, entry.name)):
            return Diagnosis("weights", "problem", damage)
    networks = [entry.name for entry in installed if entry.name in ("vgg19", "vgg16")]
    if not networks:
        text = (
            "no network is installed. Run `sgsst weights fetch vgg19` (575 MB) or `sgsst weights fetch vgg16` (64 MB)."
        )
        return Diagnosis("weights", "problem", text)
    return Diagnosis("weights", "works", f"{' and '.join(networks)} installed and undamaged")


def _caches() -> Iterator[Diagnosis]:
    """Yield a finding for each folder that cannot be written; if all can be, a single finding."""
    from sgsst_core.compiled import kernel_folders
    from sgsst_core.errors import OutputError
    from sgsst_core.features.weight_files import cache_folder
    from sgsst_core.files.atomic import ensure_writable_folder

    importlib.import_module("sgsst_core.rasterizer.kernels")  # registers the folder of its compiled kernels
    triton = Path(os.environ.get("TRITON_CACHE_DIR") or Path(os.environ.get("TRITON_HOME") or Path.home()) / ".triton")
    variables = {
        cache_folder(): "SGSST_CACHE",
        triton: "TRITON_CACHE_DIR",
        **dict.fromkeys(kernel_folders(), "NUMBA_CACHE_DIR"),
    }
    unwritable = not kernel_folders()
    if unwritable:
        yield Diagnosis("cache", "warning", "no folder for compiled kernels can be written. Set NUMBA_CACHE_DIR.")
    for folder, variable in variables.items():
        try:
            ensure_writable_folder(folder)
        except (OutputError, OSError):
            unwritable = True
            text = f"{folder} cannot be written, so every process compiles or downloads again. Set {variable}."
            yield Diagnosis("cache", "warning", text)
    if not unwritable:
        yield Diagnosis("cache", "works", f"{cache_folder()} and the folders of compiled kernels can be written")


def _gpu() -> Diagnosis:
    import torch

    if torch.cuda.is_available():
        device = torch.device("cuda", torch.cuda.current_device())
        capability = ".".join(map(str, torch.cuda.get_device_capability(device)))
        driver = (*nvidia_smi(device, "driver_version"), "unknown")[0]
        name, library = torch.cuda.get_device_name(device), torch.version.cuda or torch.version.hip
        text = f"{torch.cuda.device_count()} x {name}, compute capability {capability}, CUDA {library}, driver {driver}"
        return Diagnosis("GPU", "works", text)
    devices = ("/dev/nvidia0", "/proc/driver/nvidia/version", "/dev/kfd")
    if not any(Path(path).exists() for path in devices) and shutil.which("nvidia-smi") is None:
        return Diagnosis("GPU", "works", "there is none; jobs run on the CPU")
    if torch.version.cuda is None and torch.version.hip is None:
        text = "there is one, but this PyTorch is built for CPUs only. Install a build for its CUDA or ROCm version."
        return Diagnosis("GPU", "warning", text)
    try:
        torch.zeros(1, device="cuda")
    except Exception as error:  # whatever the exception, it says why
        return Diagnosis("GPU", "warning", f"PyTorch cannot use it: {str(error).splitlines()[0]} Update its driver.")
    return Diagnosis("GPU", "warning", "PyTorch sees none. Check CUDA_VISIBLE_DEVICES and the driver.")


def nvidia_smi(device: torch.device, *fields: str) -> list[str]:
    """Return the values of fields of `nvidia-smi --query-gpu`; empty if `nvidia-smi` is missing or fails."""
    import torch

    uuid = getattr(torch.cuda.get_device_properties(device), "uuid", None)
    chosen = [f"--id=GPU-{uuid}"] if uuid else []
    answer = output_of("nvidia-smi", *chosen, f"--query-gpu={','.join(fields)}", "--format=csv,noheader") or ""
    values = [value.strip() for value in answer.split("\n")[0].split(",")]
    return values if len(values) == len(fields) and answer else []


def output_of(program: str, *arguments: str) -> str | None:
    """Return what a program prints; None if it is missing, fails or takes too long."""
    try:
        done = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=_TIMEOUT)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def package_version(name: str) -> str | None:
    """Return the version of an installed distribution; None if it is missing."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _memory(device: torch.device) -> Diagnosis:
    from sgsst_core.budget import default_memory_limit

    gigabytes = default_memory_limit(device) / 1e9
    where = "of the GPU's" if device.type == "cuda" else "of"
    text = f"jobs plan with {gigabytes:.1f} GB {where} memory"
    if gigabytes >= _LITTLE_MEMORY:
        return Diagnosis("memory", "works", text)
    return Diagnosis("memory", "warning", f"{text}, enough for small views only. End other programs.")


def _rasterizer(*, gpu: bool) -> tuple[str, Diagnosis]:
    """Return the rasterizer of jobs on this machine, and the finding about it."""
    from sgsst_core.parallel.collectives import ALONE
    from sgsst_core.planning.facts import gpu_problems
    from sgsst_core.rasterizer import RASTERIZERS, rasterizer_for

    problems = gpu_problems(ALONE) if gpu else {}
    name = rasterizer_for("cuda" if gpu else "cpu", problems)
    texts = [f"{RASTERIZERS[each].title} cannot be used: {problem}" for each, problem in problems.items()]
    if not gpu:
        return name, Diagnosis("rasterizer", "works", "views are rendered on the CPU")
    if not RASTERIZERS[name].on_gpu:
        return name, Diagnosis("rasterizer", "warning", f"views are rendered on the CPU; {'; '.join(texts)}")
    return name, Diagnosis("rasterizer", "works", "; ".join([f"{RASTERIZERS[name].title} works here", *texts]))


def _results(rasterizer: str, device: torch.device) -> Iterator[Diagnosis]:
    """Yield a finding for each wrong result; if all are right, a single finding."""
    import torch

    from sgsst_core.bench.device_checks import CheckSizes, check_device
    from sgsst_core.rasterizer import RASTERIZERS

    where = device if RASTERIZERS[rasterizer].on_gpu else torch.device("cpu")
    sizes = CheckSizes() if where.type == "cuda" else CheckSizes(repeats=3, channels=16)
    wrong = total = 0
    for check in check_device(rasterizer, where, sizes):
        total += 1
        if not check.passed:
            wrong += 1
            text = f"wrong {check.name}: {check.error:.3g} exceeds {check.bound:.3g}"
            yield Diagnosis("results", "problem", f"{text}. Do not trust results of this machine.")
    if not wrong:
        yield Diagnosis("results", "works", f"{total} checks agree with float64 references, and repeat bit by bit")


def _precision() -> Diagnosis:
    """Return the precision that jobs choose, and those that can be requested."""
    from sgsst_core.parallel.collectives import ALONE
    from sgsst_core.planning.facts import describe_machine
    from sgsst_core.planning.plan import choose_precision
    from sgsst_core.settings import make_settings

    machine, settings = describe_machine(make_settings(), ALONE), make_settings(precision="auto")
    names = ", ".join(("float32", *machine.precisions))
    return Diagnosis("precision", "works", f"jobs use {choose_precision(settings, machine)}; possible: {names}")


def _kernels() -> Diagnosis:
    """Compile the kernels of jobs that no check has used, so that the first job does not wait for them."""
    from sgsst_core.bench.compile_kernels import compile_kernels

    compile_kernels()
    return Diagnosis("kernels", "works", "compiled for all jobs")


def main() -> None:
    """Print all findings as lines of JSON, and an empty line for each kernel that is compiled meanwhile."""
    from sgsst_core.compiled import compilations_reported

    with compilations_reported(lambda: print(flush=True)):
        for finding in findings():
            print(json.dumps(asdict(finding)), flush=True)


if __name__ == "__main__":
    main()
