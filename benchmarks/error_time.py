"""Collection of `sgsst bench error-time` results in benchmarks/results/error_time.json, their table and their figure.

python -m benchmarks.error_time cameras SCENE FILE  # write a ring of eight cameras of 990x742, for an object scan
python -m benchmarks.error_time add NAME FOLDER     # store what a run wrote to FOLDER/error_time.json, under NAME
python -m benchmarks.error_time show [--figure FILE.png]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from benchmarks.common import RESULTS
from sgsst_core.bench.variants import MOMENTS, SLICES
from sgsst_core.files.atomic import write_json
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit import orbit
from sgsst_core.report.charts import (
    X_MARGIN,
    Floats,
    column,
    draw_legend,
    draw_points,
    joined,
    log_limits,
    png_chart,
    set_log_x,
    set_log_y,
)
from sgsst_core.report.images import color_of
from sgsst_core.scene.camera import Camera

STORE = RESULTS / "error_time.json"
#: Evaluations that the table shows: after an eighth and all of the seconds.
SHOWN = (2, 5)
#: Variants in the order of their columns, lines and colors.
VARIANTS = ("standard", "float32", "preview", "paper")
HEAD = f"| pair | after | {' | '.join(VARIANTS)} |\n|---|---|{'---|' * len(VARIANTS)}"
#: Size of the figure in inches, and its resolution.
SIZE, DPI = (11, 5), 80


def main() -> None:
    """Store a run, or print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    placing = ways.add_parser("cameras")
    placing.add_argument("scene", type=Path)
    placing.add_argument("file", type=Path)
    adding = ways.add_parser("add")
    adding.add_argument("name", help="of the pair")
    adding.add_argument("folder", type=Path)
    ways.add_parser("show").add_argument("--figure", type=Path, help="PNG to write")
    arguments = parser.parse_args()
    if arguments.way == "cameras":
        write_cameras(arguments.file, orbit(read_scene(arguments.scene).scene, 8, width=990, height=742))
        return
    pairs = stored()
    if arguments.way == "add":
        pairs[arguments.name] = json.loads((arguments.folder / "error_time.json").read_text())
        write_json(STORE, {"pairs": pairs})
        return
    print(table(pairs))
    if arguments.figure:
        write_figure(arguments.figure, pairs)


def write_cameras(path: Path, cameras: Sequence[Camera]) -> None:
    """Write cameras as cameras.json of the original 3DGS code."""
    poses = [camera.world_to_camera.double().inverse() for camera in cameras]
    entries = [
        {
            "id": index,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": pose[:3, 3].tolist(),
            "rotation": pose[:3, :3].tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
        }
        for index, (camera, pose) in enumerate(zip(cameras, poses, strict=True))
    ]
    path.write_text(json.dumps(entries, indent=1))


def stored() -> dict[str, Any]:
    """Return the stored runs by pair."""
    pairs: dict[str, Any] = json.loads(STORE.read_text())["pairs"] if STORE.exists() else {}
    return pairs


def table(pairs: dict[str, Any]) -> str:
    """Return a Markdown table of loss, style and color distance at the `SHOWN` evaluations."""
    rows = [HEAD]
    for name, run in pairs.items():
        courses = _courses(run)
        for index in SHOWN:
            cells = [_cell(courses[variant][index]) if variant in courses else "" for variant in VARIANTS]
            after = run["budget_seconds"] * MOMENTS[index] / SLICES
            rows.append(f"| {name} | {after:.0f} s | {' | '.join(cells)} |")
    return "\n".join(rows)


def _cell(point: dict[str, Any]) -> str:
    judgment = point["judgment"]
    return f"{point['relative']:.3f}, {judgment['style']:.3f}, {judgment['color_distance']:.0f}"


def write_figure(path: Path, pairs: dict[str, Any]) -> None:
    """Write a PNG with a column per pair: the loss left, and below it the distance from the style.

    Raises:
        OutputError: If the file cannot be written.
    """
    with png_chart(path, SIZE, DPI) as figure:
        panels = figure.subplots(2, len(pairs), squeeze=False)
        for (name, run), (above, below) in zip(pairs.items(), panels.T, strict=True):
            courses = _courses(run)
            losses = {variant: [point["relative"] for point in points] for variant, points in courses.items()}
            styles = {variant: [point["judgment"]["style"] for point in points] for variant, points in courses.items()}
            seconds = {variant: [point["seconds"] for point in points] for variant, points in courses.items()}
            _draw(above, seconds, losses)
            _draw(below, seconds, styles)
            above.set_title(name)
            above.set_xlabel("")
        panels[0, 0].set_ylabel("loss left")
        panels[1, 0].set_ylabel("style, by AlexNet")
        draw_legend(figure, in_row=len(VARIANTS))


def _draw(axes: Axes, seconds: dict[str, list[float]], values: dict[str, list[float]]) -> None:
    """Draw a line per variant on logarithmic axes."""
    columns: list[Floats] = []
    for variant, own in values.items():
        index = VARIANTS.index(variant)
        columns.append(column(own))
        draw_points(
            axes, column(seconds[variant]), columns[-1], marker="osD^"[index], color=color_of(index), label=variant
        )
    set_log_x(
        axes, log_limits(joined([column(each) for each in seconds.values()]), X_MARGIN), "seconds of optimization"
    )
    set_log_y(axes, columns)


def _courses(run: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return the evaluations of each variant that was not skipped."""
    return {name: variant["points"] for name, variant in run["variants"].items() if variant["points"]}


if __name__ == "__main__":
    main()
