"""Seconds from the start of a process to its first pictures, as a job of the service writes them.

python -m benchmarks.first_picture SCENE STYLE OUT [--cameras FILE] [--preset preview] [--seconds 30]

Without --cameras, views are an orbit of 24. Previews are written to OUT before planning, and then after each
step until `--seconds` have passed.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import psutil

from sgsst_core import make_settings
from worker.job import JobSpec, SceneRequest
from worker.prepare import prepare
from worker.previews import Previews
from worker.styles import StyleFile


def main() -> None:
    """Run a job until `--seconds` have passed, and print when each preview was written."""
    started = psutil.Process().create_time()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("style", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--seconds", type=float, default=30)
    arguments = parser.parse_args()
    source = SceneRequest(scene=arguments.scene, cameras=arguments.cameras, orbit=None if arguments.cameras else 24)
    settings, styles = make_settings(arguments.preset), (StyleFile(arguments.style),)
    arguments.out.mkdir(parents=True, exist_ok=True)
    request = JobSpec(
        source=source, styles=styles, out=arguments.out / "stylized.ply", settings=settings, backbone="vgg16"
    )
    preview = Previews(arguments.out / "previews", 0.0, print)
    job = prepare(request, preview=preview)
    from worker.execute import execute  # as jobs of the service do: after the first preview

    execute(
        job,
        progress=lambda progress: None,
        stop=lambda: time.time() - started > arguments.seconds,
        warn=print,
        preview=preview,
    )
    for path in sorted((arguments.out / "previews").iterdir()):
        print(f"{path.name}: {path.stat().st_mtime - started:.1f} s after the process started")


if __name__ == "__main__":
    main()
