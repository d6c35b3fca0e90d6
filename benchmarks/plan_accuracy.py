"""Accuracy of the time and memory that `sgsst plan` predicts, and of the remaining time that a running job reports.

    python -m benchmarks.plan_accuracy SCENE.ply:RESOLUTION[:COARSE:SOS] ... --cameras FILE --style STYLE [--views 6]

Each case is planned by `sgsst plan` in one process, and runs like `sgsst stylize` in another process, with COARSE steps
in phase 1 and SOS steps in phase 2. Predicted and measured values are compared for the seconds of a step on a view that
was visited before, the additional seconds of a first visit (both by phase), peak memory, and time of measurements.
After each step, the reported remaining time is recorded, and compared with the actual time until the last file is
written.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.machine import write_result

#: Default steps of phase 1 and phase 2.
_STEPS = (9, 9)


def main() -> None:
    """Measure, print and store all cases; with --run, run one job and print its figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", metavar="SCENE.ply:RESOLUTION[:COARSE:SOS]")
    parser.add_argument("--cameras", type=Path, required=True)
    parser.add_argument("--style", type=Path, required=True)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--measure", type=float, default=0.1)
    parser.add_argument("--memory-limit", type=int, help="bytes")
    parser.add_argument("--name", default="plan_accuracy", help="of the file in benchmarks/results")
    parser.add_argument("--run", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        print(json.dumps(_run(arguments)))
        return
    cases = []
    for case in arguments.cases:
        cases.append(_case(case, arguments))
        _print(cases[-1])
        write_result(arguments.name, {"views": arguments.views, "measure": arguments.measure, "cases": cases})


def _options(case: str, arguments: argparse.Namespace) -> tuple[str, list[str]]:
    """Return the scene of a case, and its command line options."""
    scene, resolution, *steps = case.split(":")
    coarse, sos = steps or _STEPS
    options = ["--cameras", str(arguments.cameras), "--style", str(arguments.style), "--views", str(arguments.views)]
    options += ["--resolution", resolution, "--steps-coarse", str(coarse), "--steps-sos", str(sos), "--no-early-stop"]
    options += ["--measure", str(arguments.measure)]
    options += ["--memory-limit", str(arguments.memory_limit)] if arguments.memory_limit else []
    return scene, options


def _case(case: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Plan and run a case in two processes, and return predicted and measured values with their ratios."""
    scene, options = _options(case, arguments)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.json"
        started = time.perf_counter()
        command = [sys.executable, "-m", "api.cli", "plan", scene, *options, "--out", str(path)]
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        planning = time.perf_counter() - started
        plan = json.loads(path.read_text())
    own = [argument for argument in sys.argv[1:] if argument not in arguments.cases]
    command = [sys.executable, "-m", "benchmarks.plan_accuracy", case, *own, "--run"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    run = json.loads(done.stdout.splitlines()[-1])
    expected = plan["prediction"]
    ratios = {
        name: expected[name] / run["took"][name] if run["took"].get(name) else None
        for name in ("seconds", "seconds_coarse", "first_visit", "first_visit_coarse", "measuring", "job", "peak_bytes")
    }
    return {"case": case, "planning_seconds": planning, "expected": expected, "ratios": ratios, **run}


def _run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run one job from input files to output files, and return its measured values and predicted remaining times."""
    started = time.perf_counter()
    # Imported here, because the time of imports is part of the job's time.
    from sgsst_core.budget import peak_memory
    from worker.execute import execute
    from worker.job import JobSpec, SceneRequest
    from worker.options import StylizeOptions
    from worker.prepare import prepare
    from worker.run import Listener
    from worker.styles import StyleFile

    (case,) = arguments.cases
    scene, resolution, *steps = case.split(":")
    coarse, sos = map(int, steps or _STEPS)
    chosen = {"memory_limit": arguments.memory_limit} if arguments.memory_limit else {}
    options = StylizeOptions.model_validate(
        {
            "views": arguments.views,
            "resolution": int(resolution),
            "steps_coarse": coarse,
            "steps_sos": sos,
            "early_stop": False,
            "measure": arguments.measure,
            **chosen,
        }
    )
    promises: list[tuple[str, int, float, float, float]] = []  # stage, step, seconds of steps, clock, seconds left
    with tempfile.TemporaryDirectory() as folder:
        source = SceneRequest.of(Path(scene), arguments.cameras, options)
        out = Path(folder) / "stylized.ply"
        styles, settings = (StyleFile(arguments.style),), options.settings()
        request = JobSpec(source=source, styles=styles, out=out, settings=settings, backbone=options.backbone)
        job = prepare(request)
        prepared = time.perf_counter() - started
        begun = peak_memory()

        def progress(now: Any) -> None:
            if now.is_step and now.views_to_check is None:
                promises.append((now.stage, now.step, now.seconds, time.perf_counter(), now.eta_s))

        execute(job, Listener(progress=progress, warn=print))
        ended = time.perf_counter()
        report = json.loads((Path(folder) / "stylized.report.json").read_text())
    history, plan = report["history"], report["plan"]
    took = {**plan["measured"], "job": report["seconds"] + report["measuring"]["seconds"]}
    return {
        "prepared_seconds": prepared,
        "prepared_peak_bytes": begun,
        "first_step_seconds": promises[0][3] - started,
        "took": {**took, "peak_bytes": peak_memory(), "whole": ended - started},
        "own_plan": plan["prediction"],
        "parts": report["seconds_by_part"],
        "measuring": report["measuring"],
        "memory_by_step": [record["memory_bytes"] for record in history],
        "promises": [
            {"stage": stage, "step": step, "promised": left, "took": ended - clock, "ratio": left / (ended - clock)}
            for stage, step, _, clock, left in promises
        ],
    }


def _print(case: dict[str, Any]) -> None:
    planned, first = case["planning_seconds"], case["first_step_seconds"]
    print(f"{case['case']}: planned in {planned:.1f} s, first step after {first:.1f} s")
    for name, ratio in case["ratios"].items():
        if ratio is not None:
            unit = 1e9 if name == "peak_bytes" else 1.0
            values = f"planned {case['expected'][name] / unit:<9.3f} took {case['took'][name] / unit:<9.3f}"
            own = case["own_plan"][name] / case["took"][name]
            print(f"  {name:<20}{values} ratio {ratio:.2f} (the job's own plan {own:.2f})")
    print("  parts", case["parts"], "measuring", case["measuring"])
    ratios = (f"{promise['stage'][:1]}{promise['step']}:{promise['ratio']:.2f}" for promise in case["promises"])
    print("  promised over taken:", *ratios, flush=True)


if __name__ == "__main__":
    main()
