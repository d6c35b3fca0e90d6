"""Collection of `sgsst bench quality` results in benchmarks/results/quality.json, and Markdown tables of them.

python -m benchmarks.quality_tables add NAME FOLDER   # store what a run wrote to FOLDER/quality.json, under NAME
python -m benchmarks.quality_tables show [NAME...]    # print tables of the judgments, and of the loss over time
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks.machine import RESULTS
from sgsst_core.bench.quality import UNSTYLIZED
from sgsst_core.files.atomic import atomic_path

STORE = RESULTS / "quality.json"
_JUDGED = (
    "| | style | color distance | content | background sensitivity | short RMSE | loss left | steps |\n"
    "|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    """Store a run, or print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    adding = ways.add_parser("add")
    adding.add_argument("name", help="of the pair, and of what is special about the run")
    adding.add_argument("folder", type=Path)
    ways.add_parser("show").add_argument("names", nargs="*", help="all, if none is given")
    arguments = parser.parse_args()
    stored = json.loads(STORE.read_text())
    if arguments.way == "add":
        if not (arguments.folder / "quality.json").is_file():
            parser.error(f"{arguments.folder}: holds no quality.json; name the --out folder of `sgsst bench quality`")
        stored["pairs"][arguments.name] = read_run(arguments.folder)
        with atomic_path(STORE) as temporary:
            temporary.write_text(json.dumps(stored, indent=2) + "\n")
        return
    if unknown := set(arguments.names) - set(stored["pairs"]):
        parser.error(f"{STORE} has no {sorted(unknown)}; it has {list(stored['pairs'])}")
    for name in arguments.names or stored["pairs"]:
        run = stored["pairs"][name]
        print(f"{name}\n\n{judged(run['outcomes'])}\n\n{against_time(run['error_time']['variants'])}\n")


def read_run(folder: Path) -> dict[str, Any]:
    """Read the result of a run, with the paths of scene and style replaced by their names."""
    run: dict[str, Any] = json.loads((folder / "quality.json").read_text())
    run["scene"] = "/".join(Path(run["scene"]).parts[-2:])
    run["style"] = Path(run["style"]).name
    return run


def judged(outcomes: list[dict[str, Any]]) -> str:
    """Return a table of the judgments, with the best style and color distances of stylized outcomes in bold."""
    stylized = [outcome for outcome in outcomes if outcome["name"] != UNSTYLIZED]
    best = {figure: min(outcome[figure] for outcome in stylized) for figure in ("style", "color_distance")}

    def cell(outcome: dict[str, Any], figure: str, digits: int) -> str:
        text = f"{outcome[figure]:.{digits}f}"
        return f"**{text}**" if outcome in stylized and outcome[figure] == best[figure] else text

    rows = [_JUDGED]
    for outcome in outcomes:
        short = outcome["consistency"]["short"]
        cells = [
            outcome["name"],
            cell(outcome, "style", 3),
            cell(outcome, "color_distance", 1),
            f"{outcome['content']:.3f}",
            f"{outcome['background_sensitivity']:.3f}",
            f"{short['rmse']:.3f}" if short else "",
            "" if outcome["loss"] is None else f"{outcome['loss']:.3f}",
            str(outcome["steps"] or ""),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def against_time(variants: dict[str, Any]) -> str:
    """Return a table of each variant's loss and number of steps at each evaluation, with the range of its seconds."""
    points = {name: variant["points"] for name, variant in variants.items() if variant["points"]}
    moments = [[point["seconds"] for point in column] for column in zip(*points.values(), strict=True)]
    heads = [f"{min(moment):.0f} to {max(moment):.0f} s" for moment in moments]
    rows = [f"| | {' | '.join(heads)} |", f"|---|{'---|' * len(heads)}"]
    for name, course in points.items():
        cells = [f"{point['relative']:.3f} ({point['step']})" for point in course]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


if __name__ == "__main__":
    main()
