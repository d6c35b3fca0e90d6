"""Command-line options that define regions of a scene. `worker.region_requests` interprets them."""

from __future__ import annotations

from typing import Annotated

import typer

RegionOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME:SPEC",
        help="Region of the scene: box=X0,Y0,Z0,X1,Y1,Z1, sphere=X,Y,Z,R, half-space=A,B,C,D (Ax+By+Cz>=D), "
        "property=NAME>VALUE, mask=FILE.npy (a flag for each Gaussian) or masks=FOLDER (images of views, white inside "
        "the region). May be repeated; where regions overlap, the later one wins.",
    ),
]
RegionStyleOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=FILE[:WEIGHT]", help="Style image of a region. Several are mixed. [default: the job's style]"
    ),
]
RegionWeightOption = Annotated[
    list[str] | None, typer.Option(metavar="NAME=WEIGHT", help="Weight of a region's style in the loss. [default: 1]")
]
RegionKeepOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME", help="Freeze a region: its colors stay bit-identical. rest: all Gaussians without a region."
    ),
]
