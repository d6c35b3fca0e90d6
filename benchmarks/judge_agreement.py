"""Agreement of the judges of a result with each other, over all stored runs, as a Markdown table.

python -m benchmarks.judge_agreement

Two judges agree if they rank the runs of one pair of scene and style alike. A cell is the mean of Spearman's rank
correlations of all pairs, weighted by their numbers of runs, and in parentheses the number of runs. Runs of different
pairs are never ranked together, because figures depend on scene and style. Every figure is lower if a result is nearer
to the style, or to the unstylized scene.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from scipy.stats import spearmanr

from benchmarks.judged import UNSTYLIZED
from benchmarks.machine import RESULTS

#: Judges and their names in the table: nearness to the style, then to the unstylized scene.
JUDGES = {
    "style": "style",
    "interior_style": "interior style",
    "sliced_features": "sliced features",
    "color_distance": "color distance",
    "content": "content",
    "features": "features",
}
#: Result files with judged runs, by pair.
FILES = ("quality", "equal_steps", "training_background", "cross_validation")
#: Minimum number of runs of a pair that are ranked.
LEAST_RUNS = 3

Run = Mapping[str, Any]


def main() -> None:
    """Print the table."""
    print(table(stored_runs()))


def stored_runs() -> list[list[Run]]:
    """Return the judged stylized runs of each stored pair."""
    runs = []
    for name in FILES:
        for pair in json.loads((RESULTS / f"{name}.json").read_text())["pairs"].values():
            rows = pair.get("rows") or {outcome["name"]: outcome for outcome in pair["outcomes"]}
            runs.append([row for row_name, row in rows.items() if row_name != UNSTYLIZED])
    return runs


def table(pairs: Sequence[Sequence[Run]]) -> str:
    """Return a Markdown table of the agreement of all judges."""
    names = list(JUDGES.items())
    lines = [f"| | {' | '.join(name for _, name in names[:-1])} |", f"|---|{'---|' * (len(names) - 1)}"]
    for index, (judge, name) in enumerate(names[1:], 1):
        cells = [_cell(agreement(pairs, judge, other)) for other, _ in names[:index]]
        lines.append(f"| {' | '.join([name, *cells, *[''] * (len(names) - 1 - index)])} |")
    return "\n".join(lines)


def agreement(pairs: Sequence[Sequence[Run]], first: str, second: str) -> tuple[float, int]:
    """Return the mean rank correlation of two judges, and the number of runs that it comes from.

    Pairs with fewer than `LEAST_RUNS` runs that both have judged, or for which one finds all runs equal, do not count.
    The correlation is NaN if no pair counts.
    """
    total, count = 0.0, 0
    for runs in pairs:
        figures = [(run[first], run[second]) for run in runs if None not in (run.get(first), run.get(second))]
        if len(figures) >= LEAST_RUNS and all(len(set(each)) > 1 for each in zip(*figures, strict=True)):
            total += len(figures) * float(spearmanr(figures).statistic)
            count += len(figures)
    return total / count if count else float("nan"), count


def _cell(cell: tuple[float, int]) -> str:
    correlation, count = cell
    return f"{correlation:.2f} ({count})" if count else "-"


if __name__ == "__main__":
    main()
