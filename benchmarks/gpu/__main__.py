"""Measure correctness, speed and memory use on this machine's GPU, in one command, with results in one file.

    python -m benchmarks.gpu [--quick] [--only PART ...] [--gaussians 1000000,3000000,6000000] [--out FILE.json]

All parts together take less than twelve minutes. Without a GPU, small sizes run in Triton's interpreter, which tests
the benchmark but says nothing about speed. Results are written to benchmarks/results/gpu_DEVICE.json. The exit status
is 1 if a part has failed.
"""

import argparse
import contextlib
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.common import RESULTS, write_result
from benchmarks.gpu.part import QUICK, Findings, Sizes
from tests import triton_interpreter

#: Module and time limit in seconds of each part, the most telling parts first. The first parts load the libraries from
#: disk and compile the kernels and the CPU rasterizer.
PARTS = {
    "job": ("job", 360),
    "poison": ("correctness", 50),
    "parity": ("correctness", 45),
    "step": ("speed", 90),
    "raster": ("speed", 25),
    "ranks": ("correctness", 45),
    "curve": ("correctness", 90),
}
#: Factor on the time limits without a GPU, where the CPU may be busy and times mean nothing.
_PATIENCE = 10


def main() -> int:
    """Run all parts, or the single part that this process was started for."""
    arguments = parse()
    if not torch.cuda.is_available():
        os.environ["TRITON_INTERPRET"] = "1"  # read when a part's process first imports the kernels
    if arguments.findings:
        if not torch.cuda.is_available():
            triton_interpreter.prepare()
        return run_part(arguments.only[0], arguments)
    name = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    parts = {}
    for part in arguments.only or PARTS:
        print(f"\n{part}", flush=True)
        parts[part] = in_a_process(part, PARTS[part][1] * (_PATIENCE if arguments.quick else 1))
        print(f"{part}: {parts[part]['status']}, {parts[part]['seconds']} s", flush=True)
        if "reason" in parts[part]:
            print(f"  {parts[part]['reason']}", flush=True)
    figures = {"device": name, "quick": arguments.quick, "torch": torch.__version__, "parts": parts}
    where = arguments.out or RESULTS / f"gpu_{re.sub(r'[^a-z0-9]+', '_', name.lower()).strip('_')}.json"
    print(f"\n{write_result(where.stem, figures, where.parent)}")
    return int(any(part["status"] == "failed" for part in parts.values()))


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes; always so without a GPU")
    parser.add_argument("--only", nargs="+", choices=tuple(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--gaussians", help="numbers of Gaussians, with commas between them")
    parser.add_argument("--out", type=Path, help="JSON file of the results")
    parser.add_argument("--findings", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.quick = arguments.quick or not torch.cuda.is_available()
    return arguments


def sizes_of(arguments: argparse.Namespace) -> Sizes:
    """Return the requested sizes."""
    sizes = QUICK if arguments.quick else Sizes()
    if arguments.gaussians:
        sizes = replace(sizes, gaussians=tuple(int(count) for count in arguments.gaussians.split(",")))
    return sizes


def in_a_process(part: str, budget: float) -> dict[str, Any]:
    """Run a part in a separate process, and return status, seconds and findings (incomplete after a timeout)."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path, errors = Path(folder) / "findings.json", Path(folder) / "errors.txt"
        command = [sys.executable, "-m", "benchmarks.gpu", *_without_parts(sys.argv[1:]), "--only", part]
        with errors.open("w") as stderr:  # in a separate session, so that its child processes can be killed with it
            process = subprocess.Popen([*command, "--findings", path], stderr=stderr, start_new_session=True)
            try:
                status = process.wait(budget)
                problem = {} if status == 0 else {"reason": f"status {status}: {errors.read_text()[-4000:]}"}
            except subprocess.TimeoutExpired:
                problem = {"reason": f"its {budget:.0f} seconds were up"}
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        findings = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    ended = {"status": "failed", **problem} if problem else findings.pop("_ended")
    return {**ended, "seconds": round(time.perf_counter() - started, 1), "findings": findings}


def _without_parts(arguments: list[str]) -> list[str]:
    """Return the command line without options that select parts."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--only", nargs="+")
    return parser.parse_known_args(arguments)[1]


def run_part(part: str, arguments: argparse.Namespace) -> int:
    """Run one part in this process, and add its status as the last finding."""
    findings = Findings(arguments.findings)
    try:
        getattr(importlib.import_module(f"benchmarks.gpu.{PARTS[part][0]}"), part)(sizes_of(arguments), findings)
    except Exception:
        findings.end({"status": "failed", "reason": traceback.format_exc()})
    else:
        status = (
            {"status": "failed", "reason": "; ".join(findings.broken)} if findings.broken else {"status": "succeeded"}
        )
        findings.end(status)
    return 0


if __name__ == "__main__":
    sys.exit(main())
