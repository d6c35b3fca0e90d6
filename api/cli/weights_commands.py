"""Commands for the weights of the feature network: `weights list`, `fetch` and `path`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from api.cli.console import FAILURE, error_console, out_console
from api.cli.progress_bars import transfer_bar

weights_app = typer.Typer(help="Weights of the feature network.", no_args_is_help=True)


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
