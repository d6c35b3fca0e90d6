"""Command-line options that define regions of a scene. `worker.regions` interprets them."""

from __future__ import annotations

from typing import Annotated

import typer

RegionOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME:SPEC",
        help="A region of the scene: box=X0,Y0,Z0,X1,Y1,Z1, sphere=X,Y,Z,R, half-space=A,B,C,D (Ax+By+Cz>=D), "
        "property=NAME>VALUE, mask=FILE.npy (a flag for each Gaussian) or masks=FOLDER (pictures of views, white is "
        "in). May be given several times; where regions overlap, the later one counts.",
    ),
]
RegionStyleOption = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=FILE[:WEIGHT]", help="Style of a region. Several are mixed. [the job's own]"),
]
RegionWeightOption = Annotated[
    list[str] | None, typer.Option(metavar="NAME=WEIGHT", help="How much a region's style counts in the loss. [1]")
]
RegionKeepOption = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Leave a region as it is, to the last bit; rest is what no region has."),
]
