"""Seconds of whole commands by part: from the command to the first step, in the steps, and to the last file.

python -m benchmarks.job_parts SCENE.ply CAMERAS STYLE [-- OPTIONS]

Scenes of millions of Gaussians are copies of the given one (`large_scene.multiplied`). Each command is a process of its
own. What its report does not name is the process's own start and end, in `unnamed`. Medians are stored.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from benchmarks.common import parse, write_result
from benchmarks.large_scene import multiplied
from sgsst_core.files.scene_file import read_scene, write_scene

SGSST = [sys.executable, "-m", "api.cli"]
#: Commands that only start the program.
STARTS = ("--version", "--help")
#: Millions of Gaussians, number of views, and number of runs.
MILLIONS, VIEWS, ROUNDS = (0.05, 4), "24", 3


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("cameras")
    parser.add_argument("style")
    parser.add_argument("options", nargs="*", help="of `sgsst stylize`, after --")
    arguments = parse(parser)
    scene = read_scene(arguments.scene).scene
    starts = {name: median(command_seconds([name]) for _ in range(ROUNDS)) for name in STARTS}
    jobs = {}
    with tempfile.TemporaryDirectory() as folder:
        ply, out = Path(folder, "scene.ply"), Path(folder, "out.ply")
        for millions in MILLIONS:
            write_scene(ply, multiplied(scene, round(millions * 1e6)))
            views = ["--cameras", arguments.cameras, "--views", VIEWS]
            job = ["stylize", str(ply), *views, "--style", arguments.style, "--out", str(out), *arguments.options]
            jobs[f"{millions:g} million"] = _job(job, out.with_suffix(".report.json"))
    for name, parts in {"starts": starts, **jobs}.items():
        total = parts.get("command", 1.0)
        print(
            name, *(f"  {part:<16}{seconds:8.2f} s {seconds / total:6.1%}" for part, seconds in parts.items()), sep="\n"
        )
    figures = {"views": VIEWS, "options": arguments.options, "starts": starts, "jobs": jobs}
    write_result("job_parts", figures, presets=["standard"], scenes={arguments.scene.parent.name: arguments.scene})


def command_seconds(command: list[str]) -> float:
    """Run an `sgsst` command in a process of its own, and return its seconds."""
    started = time.perf_counter()
    subprocess.run([*SGSST, *command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=True)
    return time.perf_counter() - started


def _job(command: list[str], report: Path) -> dict[str, float]:
    """Return the median seconds of a job by part, largest first, with those of the whole command."""
    runs = []
    for _ in range(ROUNDS):
        seconds = command_seconds(command)
        parts = json.loads(report.read_text("utf-8"))["seconds_by_part"]
        runs.append({"command": seconds, **parts, "unnamed": seconds - sum(parts.values())})
    medians = {name: median(run.get(name, 0.0) for run in runs) for name in runs[0]}
    return dict(sorted(medians.items(), key=lambda item: -item[1]))


if __name__ == "__main__":
    main()
