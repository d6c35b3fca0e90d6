"""Parameters of a job besides its files: the options of `sgsst stylize`, as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from sgsst_core.errors import SettingsError
from sgsst_core.settings import Option, checked
from worker.options import GROUPS, StylizeOptions
from worker.region_requests import MOST_REGIONS, NO_CONTROLS, RegionOptions, RegionRequest, region_requests
from worker.styles import MOST_STYLE_IMAGES

#: Maximum number of characters of a job's name.
MAX_JOB_NAME = 200
JobName = Annotated[str, Field(max_length=MAX_JOB_NAME, pattern=NO_CONTROLS)]


class JobParameters(StylizeOptions):
    """Parameters of a job; omitted ones take the preset's values, as for `sgsst stylize`."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"preset": "preview", "resolution": 480}, {"orbit": 24, "steps_sos": 100}],
            "x-groups": {title: [*names] for title, names in GROUPS.items()},
        }
    )

    name: Annotated[JobName, Option(default="the names of scene and style")] = Field(
        "", description="Display name; need not be unique."
    )
    style_weights: Annotated[
        list[Annotated[float, Field(gt=0, allow_inf_nan=False)]] | None, Option(instead="--style FILE:WEIGHT")
    ] = Field(
        None,
        min_length=1,
        max_length=MOST_STYLE_IMAGES,
        description="Weight of each style image that belongs to no region, in upload order: images are mixed in "
        "proportion. Default: equal weights.",
    )
    regions: Annotated[list[RegionOptions] | None, Option(instead="--region NAME:SPEC")] = Field(
        None,
        max_length=MOST_REGIONS + 1,
        description="Regions of the scene, each with its own style or frozen. Where regions overlap, the later one "
        "wins.",
    )

    @property
    def region_requests(self) -> tuple[RegionRequest, ...]:
        """Return the requested regions.

        Raises:
            SettingsError: If the regions are inconsistent.
        """
        return region_requests(self.regions or (), exists=lambda path: False)

    @property
    def selects_by_images(self) -> bool:
        """Whether a region is selected by masks of views, for which these views are rendered."""
        return any(region.selection and region.selection.kind == "masks" for region in self.region_requests)


def stored_parameters(values: Mapping[str, Any]) -> JobParameters:
    """Return the parameters of a stored job.

    Raises:
        SettingsError: If this version does not support them.
    """
    try:
        return checked(JobParameters, values)
    except SettingsError as error:
        raise SettingsError(
            f"{error} The job was stored by an earlier version that accepted this. Submit a new job without it."
        ) from error
