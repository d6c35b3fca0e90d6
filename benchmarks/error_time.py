"""Error against run time: whole `sgsst stylize` commands by time budget and by preset, on five pairs.

python -m benchmarks.error_time run DATA [--pairs 'SCENE, PAINTING' ...] [--ways 'within 1m' ...] [--seeds 0 1]
python -m benchmarks.error_time show [--figure FILE.png]

`run` needs a folder with scenes/ and styles/. Each way (`WAYS`) is a process of its own, timed from its start to its
last file. All ways of a pair get the same cameras, and each result is evaluated on all of them at their full size: by
the float32 loss of all scales that `standard` minimizes, relative to the unstylized scene, and on novel views by
AlexNet. What is stored for the same code is not run again. Everything takes about six hours on two cores.

`show` prints a small table of means over pairs, a table of each pair, and two lists. A way is above the lower envelope
if another one, which takes no more seconds, leaves a loss that is lower by more than 5 %. Seconds in which the next
better preset reaches the loss that a preset leaves are those of the curve in its report, from the command on. The curve
is scaled so that it ends with the evaluated loss.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib.axes import Axes

from benchmarks.common import RESULTS, add_pair, is_of_this_code, parse, read_views
from benchmarks.cross_validation import SCENES
from benchmarks.equal_steps import judge_and_loss, judged
from benchmarks.job_parts import command_seconds
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.report.images import color_of
from sgsst_core.report.page import (
    column,
    draw_legend,
    png_chart,
    round_length,
    running_mean,
    set_log,
)
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.settings import PresetName
from sgsst_core.stylizing.stylizer import BEFORE_STEPS, relative_loss

#: Scenes below DATA/scenes with their cameras.
ALL_SCENES = SCENES | {"narcissus": ("statues/narcissus.sog", "orbit:24")}
PAIRS = (
    "plush, starry_night",
    "plush, great_wave",
    "playbot, great_wave",
    "narcissus, klimt_the_kiss",
    "broche, wheat_field_with_cypresses",
)
#: Options of `sgsst stylize` by the name of a way.
WAYS: dict[str, tuple[str, ...]] = {
    **{f"within {time}": ("--within", time) for time in ("15s", "1m", "4m", "15m")},
    "preview": ("--preset", "preview"),
    "standard": ("--preset", "standard"),
    "paper, 120 of 20,000 steps": ("--preset", "paper", "--steps-coarse", "60", "--steps-sos", "60"),
}
#: Options of `standard` with one of its choices changed; run if asked for.
CHANGED: dict[str, tuple[str, ...]] = {
    "standard, float32": ("--precision", "float32"),
    "standard, bfloat16": ("--precision", "bfloat16"),
    "standard, all scales in each step": ("--scale-sampling", "1"),
    "standard, no early stop": ("--no-early-stop",),
}
EVERY_WAY = WAYS | CHANGED
BUDGETS = [way for way in WAYS if way.startswith("within")]
#: Presets that minimize the same loss, each with the next better one.
BETTER = {"preview": "standard"}
PRESETS: tuple[PresetName, ...] = ("preview", "standard", "paper")
#: Cameras of a pair, and the longer side of views of 4:3, which have two scales; others have as many pixels.
VIEWS, RESOLUTION = 12, 720
#: Factor by which a loss may exceed the lower envelope.
TOLERANCE = 1.05
#: Title and digits of each figure of the tables.
COLUMNS = {"seconds": ("seconds", 0), "loss": ("loss left", 3), "style": ("style", 3), "color_distance": ("colors", 0)}
#: Points of a stored curve, and size of the figure in inches, and its resolution.
POINTS, SIZE, DPI = 40, (13, 5.5), 80

Row = dict[str, Any]
Runs = dict[str, list[Row]]


def main() -> None:
    """Run what is not stored, or print tables and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    running = ways.add_parser("run")
    running.add_argument("data", type=Path, help="folder with scenes/ and styles/")
    running.add_argument("--pairs", nargs="+", choices=PAIRS, default=PAIRS, metavar="PAIR")
    running.add_argument("--ways", nargs="+", choices=EVERY_WAY, default=list(WAYS), metavar="WAY")
    running.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    ways.add_parser("show").add_argument("--figure", type=Path, help="PNG to write")
    arguments = parse(parser)
    if arguments.way == "run":
        for pair in arguments.pairs:
            run(arguments.data, pair, arguments.ways, arguments.seeds)
    runs = {pair: runs_of(rows) for pair, rows in stored().items()}
    if arguments.way == "show" and arguments.figure:
        write_figure(arguments.figure, runs)
    print(report(runs))


def run(data: Path, pair: str, ways: Sequence[str], seeds: Sequence[int]) -> None:
    """Run, evaluate and store the ways of a pair that are not stored for this code."""
    known, every = stored().get(pair, {}), {f"{way}, seed {seed}": (way, seed) for seed in seeds for way in ways}
    missing = {key: each for key, each in every.items() if not is_of_this_code(known.get(key, {}).get("commit") or "")}
    if not missing:
        return
    name, painting = pair.split(", ")
    (file, source), style = ALL_SCENES[name], data / "styles" / f"{painting}.jpg"
    ply, source = data / "scenes" / file, source if source.startswith("orbit:") else str(data / "scenes" / source)
    scene = read_scene(ply).scene
    cameras = read_views(source, scene, VIEWS, RESOLUTION)
    judge, exact = judge_and_loss(scene, cameras, load_image(style), {})
    before = exact.evaluate(exact.views.covered, scene.sh_dc)
    description = {"views": len(cameras), "resolution": RESOLUTION, "unstylized": judged(judge, scene.sh_dc)}
    for key, (way, seed) in missing.items():
        with tempfile.TemporaryDirectory() as folder:
            out, views = Path(folder, "out.ply"), Path(folder, "cameras.json")
            write_cameras(views, cameras)
            inputs = [str(ply), "--cameras", str(views), "--style", str(style), "--backbone", "vgg16"]
            seconds = command_seconds(["stylize", *inputs, "--out", str(out), "--seed", str(seed), *EVERY_WAY[way]])
            colors = read_scene(out).scene.sh_dc
            job = json.loads(out.with_suffix(".report.json").read_text(encoding="utf-8"))
        loss = relative_loss(before, exact.evaluate(exact.views.covered, colors), exact.loss.weights)
        figures = {"seconds": seconds, "loss": loss, **judged(judge, colors)}
        row: Row = {figure: float(f"{value:.5g}") for figure, value in figures.items()}
        row |= {"views": job["cameras"]["count"], "sizes": job["cameras"]["sizes"]}
        row |= {"steps": len(job["history"]), "curve": curve(job) if way in BETTER.values() else None}
        add_pair("error_time", pair, description, {key: row}, presets=PRESETS, scenes={name: ply})
        print(f"{pair}, {key}: {table(key, [{way: [row]}]).splitlines()[-1]}", flush=True)


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


def curve(job: dict[str, Any]) -> list[tuple[float, float]]:
    """Return the seconds from the command and the smoothed relative loss of some steps of a report, last one included.

    Losses are geometric means over a round of views, as in the report.
    """
    start = sum(job["seconds_by_part"].get(part, 0.0) for part in BEFORE_STEPS)
    records = [record for record in job["history"] if record["stage"] == "sos"]
    relative = running_mean([record["relative"] for record in records], round_length(job))
    points = [(start + record["seconds"], float(value)) for record, value in zip(records, relative, strict=True)]
    shown = [*spread(points[:-1], POINTS), points[-1]]
    return [(round(seconds, 1), float(f"{value:.4g}")) for seconds, value in shown]


def stored() -> dict[str, dict[str, Row]]:
    """Return the stored rows of each pair; a pair of an earlier version of this benchmark has none."""
    path = RESULTS / "error_time.json"
    pairs = json.loads(path.read_text(encoding="utf-8"))["pairs"] if path.exists() else {}
    return {pair: each["rows"] for pair, each in pairs.items() if "rows" in each}


def runs_of(rows: dict[str, Row]) -> Runs:
    """Return rows, which are stored as "WAY, seed N", by way, in the order of `EVERY_WAY`."""
    runs = {way: [row for key, row in rows.items() if key.rpartition(", seed ")[0] == way] for way in EVERY_WAY}
    return {way: own for way, own in runs.items() if own}


def report(pairs: dict[str, Runs]) -> str:
    """Return tables of all pairs together and of each, the ways above the envelope, and when presets are overtaken."""
    return "\n\n".join(
        [
            table("mean over pairs", list(pairs.values())),
            *(table(pair, [runs]) for pair, runs in pairs.items()),
            *(
                f"Above the envelope on {pair}: {way}; {other} is better."
                for pair, runs in pairs.items()
                for way, other in above_envelope(runs).items()
            ),
            *(
                f"On {pair}, {better} is where {preset} ends after {text}."
                for pair, runs in pairs.items()
                for preset, better in BETTER.items()
                if (text := overtaken(runs, preset, better))
            ),
        ]
    )


def table(title: str, pairs: Sequence[Runs]) -> str:
    """Return a Markdown table of the means over pairs of each way's figures, with the range of all runs."""
    lines = [f"| {' | '.join([title, *(name for name, _ in COLUMNS.values())])} |", "|---" * (len(COLUMNS) + 1) + "|"]
    for way in WAYS if len(pairs) > 1 else EVERY_WAY:
        if runs := [each[way] for each in pairs if way in each]:
            cells = [
                _mean_and_range([[row[key] for row in rows] for rows in runs], digits)
                for key, (_, digits) in COLUMNS.items()
            ]
            lines.append(f"| {' | '.join([way, *cells])} |")
    return "\n".join(lines)


def _mean_and_range(values: Sequence[Sequence[float]], digits: int) -> str:
    """Return the mean of several means, and the range of all values."""
    every = [value for some in values for value in some]
    low, mean, high = (f"{value:.{digits}f}" for value in (min(every), fmean(map(fmean, values)), max(every)))
    return mean if low == high else f"{mean} ({low} to {high})"


def above_envelope(runs: Runs) -> dict[str, str]:
    """Return each way above the lower envelope, with the way that leaves the least loss in no more seconds."""
    means = {
        way: (fmean(row["seconds"] for row in rows), fmean(row["loss"] for row in rows)) for way, rows in runs.items()
    }
    best = {
        way: min((own, other) for other, (taken, own) in means.items() if taken <= seconds)
        for way, (seconds, _) in means.items()
    }
    return {way: other for way, (least, other) in best.items() if means[way][1] > TOLERANCE * least}


def overtaken(runs: Runs, preset: str, better: str) -> str:
    """Return the seconds after which a better preset has the loss that a preset leaves; empty if one was not run."""
    if not {preset, better} <= runs.keys():
        return ""
    left, reached = fmean(row["loss"] for row in runs[preset]), []
    for row in runs[better]:
        factor = row["loss"] / row["curve"][-1][1]
        reached += [seconds for seconds, loss in row["curve"] if factor * loss <= left][:1]
    return f"{_mean_and_range([reached], 0)} s" if len(reached) == len(runs[better]) else "its end"


def write_figure(path: Path, pairs: dict[str, Runs]) -> None:
    """Write a PNG with a column per pair: the loss left, and below it the distance from the style, against seconds.

    Time budgets are a line, other ways are points. Thin lines are the range over seeds.

    Raises:
        OutputError: If the file cannot be written.
    """
    with png_chart(path, SIZE, DPI) as figure:
        panels = figure.subplots(2, len(pairs), squeeze=False)
        for (pair, runs), (above, below) in zip(pairs.items(), panels.T, strict=True):
            _draw(above, runs, "loss")
            _draw(below, runs, "style")
            above.set_title(pair.replace(", ", "\n").replace("_", " "))
            above.set_xlabel("")
        panels[0, 0].set_ylabel("loss left")
        panels[1, 0].set_ylabel("style, by AlexNet")
        draw_legend(figure, in_row=len(WAYS))


def _draw(axes: Axes, runs: Runs, key: str) -> None:
    """Draw a figure of all ways against their seconds on logarithmic axes."""
    lines = {"--within": BUDGETS, **{way: [way] for way in WAYS if way not in BUDGETS}}
    for index, (label, ways) in enumerate(lines.items()):
        own = [runs[way] for way in ways if way in runs]
        x, y = (column([fmean(row[name] for row in rows) for rows in own]) for name in ("seconds", key))
        if len(x):  # matplotlib's layout would extend an empty, unclipped line to the corner of the figure
            axes.plot(x, y, clip_on=False, marker="osD^"[index], color=color_of(index), label=label)
        low, high = ([each(row[key] for row in rows) for rows in own] for each in (min, max))
        axes.vlines(x, low, high, color=color_of(index), linewidth=1)
    set_log(axes, "seconds from the command")


if __name__ == "__main__":
    main()
