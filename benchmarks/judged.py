"""Comparisons whose rows are judged by a network outside the loss: mean over seeds, table, and contact sheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.machine import add_pair
from sgsst_core.bench.quality import judged_row
from sgsst_core.quality.judge import Judge
from sgsst_core.report.contact_sheet import write_grid

#: Name of the row of the scene's own colors.
UNSTYLIZED = "unstylized"


def judged(judge: Judge, sh_dc: Tensor) -> dict[str, float]:
    """Return the judgment of colors [N, 3], without measures that have no value."""
    judgment = judge.judge(sh_dc)
    assert judgment is not None, "no view can be judged: give more cameras, or larger views"
    return {name: value for name, value in asdict(judgment).items() if value is not None}


def compare_rows(
    result: str,
    pair: str,
    description: dict[str, Any],
    columns: Sequence[str],
    unstylized: tuple[Tensor, dict[str, float]],
    rows: Sequence[str],
    seeds: str,
    run: Callable[[str, int], tuple[Tensor, dict[str, float]]],
) -> dict[str, Tensor]:
    """Run all rows, print them, and add them to the stored results of a pair of scene and style.

    Args:
        result: Name of the result file.
        pair: Name of the pair.
        description: Inputs and settings that all rows share.
        columns: Figures to print.
        unstylized: The scene's own colors, and their figures.
        rows: Names of the rows.
        seeds: Seeds, separated by commas. Figures are means over them; `spread` is their largest difference.
        run: Function of row and seed that returns colors [N, 3] and figures.

    Returns:
        Colors of each row, from its last seed.
    """
    colors, judgments = {UNSTYLIZED: unstylized[0]}, {UNSTYLIZED: unstylized[1]}
    print(f"{pair:28}", *(f"{name:>9}" for name in columns))
    _print_row(UNSTYLIZED, judgments[UNSTYLIZED], columns)
    for row in rows:
        results = []
        for seed in seeds.split(","):
            colors[row], figures = run(row, int(seed))
            results.append(figures)
        judgments[row] = _mean(results)
        _print_row(row, judgments[row], columns)
        add_pair(result, pair, description, judgments)
    return colors


def write_sheet(folder: Path, name: str, judge: Judge, style: Tensor, colors: dict[str, Tensor]) -> None:
    """Write each row's colors, and a contact sheet; see `judged_row`."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [judged_row(judge, row, sh_dc) for row, sh_dc in colors.items()]
    write_grid(folder / f"{name}.jpg", [[("style", style)], *rows])
    torch.save(colors, folder / f"{name}.pt")


def _mean(results: list[dict[str, float]]) -> dict[str, Any]:
    mean: dict[str, Any] = {name: sum(row[name] for row in results) / len(results) for name in results[0]}
    mean["seeds"] = len(results)
    if len(results) > 1:
        values = {name: [row[name] for row in results] for name in results[0]}
        mean["spread"] = {name: max(each) - min(each) for name, each in values.items()}
    return mean


def _print_row(name: str, row: dict[str, Any], columns: Sequence[str]) -> None:
    """Print the figures of one row in columns; missing figures stay blank."""
    print(f"{name:28}", *(f"{row[column]:9.3f}" if column in row else " " * 9 for column in columns), flush=True)
