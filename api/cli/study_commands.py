"""Blind comparisons of results by eye: `study make` and `study count`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from api.cli.arguments import CamerasOption, StyleOption, file_to_write, source_of
from api.cli.console import out_console, print_field, spinner
from api.cli.options import with_options
from worker.options import StylizeOptions, ViewOptions

#: Number of views of a study, unless --views sets it.
_VIEWS = 12

study_app = typer.Typer(help="Blind comparisons of results by eye.", no_args_is_help=True)


@study_app.command("make")
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=("background",))
def make(
    variants: Annotated[
        list[str], typer.Argument(metavar="[NAME=]SCENE...", help="Two to four scenes to compare.", show_default=False)
    ],
    style: StyleOption,
    out: Annotated[Path, typer.Option(help="HTML page to write.", callback=file_to_write)] = Path("study.html"),
    cameras: CamerasOption = None,
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Write a page on which people choose the best of two to four results, without seeing which is which.

    The page is one file, works offline and saves the votes as JSON. Keep the key, which is written beside it.
    """
    from api.cli.study import key_path, make_study, named

    source = source_of(named(variants[0])[1], cameras, options)
    if options.views is None and options.orbit is None:
        source = source.model_copy(update={"views": _VIEWS})
    with spinner("Rendering the views"):
        make_study(variants, source, style, chosen.settings().background, out)
    print_field("page", out)
    print_field("key", key_path(out))


@study_app.command("count")
def count(
    key: Annotated[Path, typer.Argument(help="Key of the study.", show_default=False)],
    votes: Annotated[list[Path], typer.Argument(help="Files of votes.", show_default=False)],
) -> None:
    """Print each variant's share of the votes, with 95 % Wilson intervals."""
    from api.cli.study import share_table
    from sgsst_core.quality.study import count_votes

    out_console.print(share_table(count_votes(key, votes)))
