"""Commands for this machine: `doctor` says what works, `weights list`, `fetch` and `path` install feature networks."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from api.cli.arguments import JsonOption
from api.cli.console import FAILURE, error_console, out_console, transfer_bar

#: Exit code if jobs run, but slower than they could.
WARNING = 3
_MARKS = {"works": "ok", "warning": "WARNING", "problem": "PROBLEM"}

weights_app = typer.Typer(help="Weights of the feature network.", no_args_is_help=True)


def doctor(as_json: JsonOption = False) -> None:
    """Examine this machine: GPU, driver, precision, memory, weights, caches, and correct results.

    It takes half a minute, and another one the first time, when it compiles the kernels of jobs.

    Exit code: 0 if everything works, 3 if jobs run but slower than they could, 1 if they fail or are wrong.
    """
    from sgsst_core.bench.doctor import examine

    findings = []
    for finding in examine():
        findings.append(finding)
        if not as_json:
            out_console.print(f"{_MARKS[finding.state]:<9}{finding.topic:<12}{finding.text}")
    if as_json:
        out_console.print(json.dumps([asdict(finding) for finding in findings], indent=2))
    states = {finding.state for finding in findings}
    if "problem" in states:
        raise typer.Exit(FAILURE)
    if "warning" in states:
        raise typer.Exit(WARNING)


@weights_app.command("list")
def list_weights() -> None:
    """Show installed weights, and the source of the others; exit with 1 if some are damaged."""
    from sgsst_core.features.network_weights import list_network_weights
    from sgsst_core.features.weight_files import damage_of

    damaged = []
    for entry in list_network_weights():
        if entry.path is not None and (damage := damage_of(entry.path, entry.name)):
            damaged.append(damage)
            state = f"DAMAGED     {entry.path}"
        else:
            state = f"installed   {entry.path}" if entry.path else f"to download from {entry.source}"
        out_console.print(f"{entry.name:<12}{entry.size / 1e6:>6.0f} MB  {state}")
    for damage in damaged:
        error_console.print(f"error: {damage}")
    if damaged:
        raise typer.Exit(FAILURE)


@weights_app.command()
def fetch(
    name: Annotated[Literal["vgg19", "vgg16"], typer.Argument(help="Network to install.")],
    from_: Annotated[
        Path | None,
        typer.Option("--from", help="Convert this file (.pth of torchvision or Gatys et al.) instead of downloading."),
    ] = None,
) -> None:
    """Download and convert weights into the cache folder; do nothing if they are installed."""
    from sgsst_core.features.network_weights import fetch_network_weights

    with transfer_bar(error_console, name) as progress:
        path = fetch_network_weights(name, source=from_, progress=progress)
    out_console.print(f"{name}: {path}")


@weights_app.command("path")
def print_path() -> None:
    """Print the cache folder for weights; set SGSST_CACHE to change it."""
    from sgsst_core.features.network_weights import cache_folder

    out_console.print(str(cache_folder()))
