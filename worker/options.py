"""Options of a job, declared once for the command line and the API.

`StylizeOptions` holds the options that both accept: view options, all settings of the method, and options of the job
itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge, Le
from pydantic import BaseModel, ConfigDict, Field, create_model

from sgsst_core.constants import NEAR
from sgsst_core.files.formats.spz import SpzAxes
from sgsst_core.scene.rendering import MAX_EPS2D, RenderMode
from sgsst_core.settings import (
    BY_PRESET,
    COLOR_SYNTAX,
    Color,
    Near,
    Option,
    PresetName,
    Resolution,
    Settings,
    declared,
    default_text,
    make_settings,
    parse_color,
    preset_texts,
)

Backbone = Literal["auto", "vgg19", "vgg16"]
Up = Literal["auto", "x", "-x", "y", "-y", "z", "-z"]
#: Titles of groups of options; see `GROUPS`.
ESSENTIALS, VIEWS, REGIONS, EXPERT = "Essentials", "Views", "Regions", "Expert"
#: Number of views of an orbit.
Views = Annotated[int, Ge(1), Le(2000)] | Literal["auto"]
#: Default longer side of a video in pixels; cameras of smaller images keep theirs.
DEFAULT_SIDE = 1280
#: Settings that no preset changes. API responses always include their values.
_SHOWN = ("preset", "seed", "precision")


class ViewOptions(BaseModel):
    """Options that determine the cameras and how they see the scene."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    orbit: Annotated[Views | None, Option(unit="views", metavar="N", default="cameras from files, else auto")] = Field(
        None,
        description="Create N views around the scene instead of reading camera files; auto: as many as its surface "
        "needs. They form rings at as many elevations as needed.",
    )
    up: Up = Field("auto", description="Up axis of the scene, for an orbit; auto: estimated from the scene.")
    elevation: Annotated[float | None, Option(unit="degrees", metavar="E", default="automatic")] = Field(
        None, gt=-90, lt=90, description="Put all cameras of an orbit in one ring, E degrees above the horizon."
    )
    radius: Annotated[float | None, Option(unit="scene units", metavar="R", default="from the scene's size")] = Field(
        None, gt=0, allow_inf_nan=False, description="Distance of an orbit's cameras from the scene's center."
    )
    views: Annotated[int | None, Option(unit="views", metavar="N", default="all")] = Field(
        None, ge=1, le=1_000_000, description="Use N of the cameras, evenly spread."
    )
    resolution: Resolution = None
    near: Near = NEAR
    drop_invalid: bool = Field(False, description="Drop Gaussians with NaN or infinite values, or without a rotation.")
    spz_axes: SpzAxes = Field(
        "auto",
        description="Axes of an SPZ scene: rub (y up, z backward) or rdf (y down, z forward, as in a PLY); auto: as "
        "the file states, else decided by cameras or the up direction, else rub.",
    )
    render_mode: RenderMode = Field(
        "auto",
        description="Rendering of Gaussians smaller than a pixel, which must be that of the scene's training; "
        "antialiased: as by Mip-Splatting, gsplat or Brush with antialiasing; auto: as the file states, else classic.",
    )
    eps2d: Annotated[
        float | None, Option(unit="square pixels", metavar="E", default="by the scene's file, else 0.3")
    ] = Field(None, gt=0, le=MAX_EPS2D, description="Blur of projected Gaussians: variance added along both axes.")


def _settings_to_choose() -> dict[str, Any]:
    """Return a model field for each setting. A field that is None takes its value from the preset."""
    fields: dict[str, Any] = {}
    for name, setting in declared(Settings).items():
        text = default_text(setting)
        if name in ViewOptions.model_fields and not text.startswith(BY_PRESET):
            continue
        info, shown = setting.info, name in _SHOWN
        constraints = [item for item in info.metadata if not isinstance(item, Option)]
        kind = info.annotation if shown else info.annotation | None  # type: ignore[operator]
        presets = preset_texts(setting) if text.startswith(BY_PRESET) else {}
        option = setting.option if shown else replace(setting.option, default=text, name="", presets=presets)
        default = Field(info.default if shown else None, description=info.description)
        fields[name] = (Annotated[kind, *constraints, option], default)
    return fields


if TYPE_CHECKING:

    class _Chosen(ViewOptions):
        preset: PresetName = "standard"

else:
    _Chosen = create_model("_Chosen", __base__=ViewOptions, **_settings_to_choose())


class StylizeOptions(_Chosen):
    """Options of `sgsst stylize` and of a job of the service. Omitted options take their values from the preset."""

    style_background: Annotated[
        Color,
        Option(unit="RGB, 0 to 1", metavar="COLOR", default="white", parse=parse_color, syntax=COLOR_SYNTAX),
    ] = Field((1.0, 1.0, 1.0), description="Color behind transparent parts of style images.")
    backbone: Backbone = Field("auto", description="Feature network; auto: VGG19 if it is installed, else VGG16.")
    pad_sh: bool = Field(
        False,
        description="Write a PLY of 248 bytes per Gaussian, as plugins for Unity need it: the usual properties alone, "
        "with spherical harmonics of degree 3, whose missing bands are 0.",
    )
    workers: Annotated[
        int | None, Option(unit="ranks", metavar="N", default="this process only; in a service, chosen by the service")
    ] = Field(
        None,
        ge=1,
        le=1024,
        description="Run on N workers, each on a GPU or a fraction of the CPU: of this machine, or of the Ray cluster "
        "at RAY_ADDRESS.",
    )

    def given_settings(self) -> dict[str, Any]:
        """Return the explicitly given settings, except the preset, by their names in `Settings`."""
        known = declared(Settings)
        given = {known[name].field: getattr(self, name) for name in self.model_fields_set & known.keys() - {"preset"}}
        return {name: value for name, value in given.items() if value is not None}

    def settings(self) -> Settings:
        """Return the settings of the method.

        Raises:
            SettingsError: If values contradict each other.
        """
        settings = make_settings(self.preset, **self.given_settings())
        views = self.views if self.orbit is None else self.orbit
        if settings.within is None or views in (None, "auto"):
            return settings
        return settings.model_copy(update={"fixed": (*settings.fixed, "views")})


#: Options by group, in the order of the page, the help texts and docs/options.md.
GROUPS: dict[str, list[str]] = {
    ESSENTIALS: ["preset", "content_weight", "within", "resolution", "views"],
    VIEWS: ["orbit", "up", "elevation", "radius"],
    "Look": [
        "style_scale",
        "style_rotation",
        "preserve_colors",
        "background",
        "style_background",
        "refine",
        "sh_attenuation",
        "unseen",
    ],
    REGIONS: ["regions"],
}
GROUPS[EXPERT] = [name for name in declared(StylizeOptions) if not any(name in names for names in GROUPS.values())]


class VideoOptions(BaseModel):
    """Options of a video of a scene."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: Literal["auto", "cameras", "orbit"] = Field(
        "auto",
        description="Path of the camera: smoothly through all cameras, or once around the scene; auto: cameras if "
        "there are camera files, else orbit.",
    )
    fps: Annotated[int, Option(unit="frames per second", metavar="N")] = Field(
        30, ge=1, le=120, description="Frames per second."
    )
    seconds: Annotated[float, Option(unit="seconds", metavar="S")] = Field(
        8.0, gt=0, le=600, allow_inf_nan=False, description="Length of the video."
    )
    transition: Literal["wipe", "fade"] = Field(
        "wipe", description="Transition from the unstylized scene: a moving line or a cross-fade."
    )

    @property
    def frames(self) -> int:
        """Return the number of frames, at least 1."""
        return max(1, round(self.seconds * self.fps))


class JobVideo(VideoOptions):
    """Video of a job's result. Its limits bound the time that a job can take for it."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"path": "cameras", "seconds": 6, "compare": True}]})

    fps: int = Field(30, ge=1, le=60, description="Frames per second.")
    seconds: float = Field(8.0, gt=0, le=30, allow_inf_nan=False, description="Length of the video in seconds.")
    resolution: int | None = Field(
        None, ge=64, le=1920, description="Longer side in pixels. Default: the cameras' own, at most 1280."
    )
    compare: bool = Field(False, description="Start with the unstylized scene, and end with the result.")


class RunOptions(BaseModel):
    """Options of `sgsst stylize` that the API does not accept: a service's operator sets them for all jobs."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    resume: bool = Field(False, description="Resume from the checkpoint beside --out.")
    checkpoint_seconds: Annotated[float, Option(unit="seconds", metavar="S")] = Field(
        60.0, ge=0, description="Seconds between checkpoints: the most that is lost with a worker."
    )
    rank_timeout: Annotated[float, Option(unit="seconds", metavar="S")] = Field(
        120.0, ge=1, description="Seconds without a response after which a worker counts as lost."
    )
