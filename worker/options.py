"""Options of a job, declared once for the command line and the API: views, settings, style files and regions.

In addition, the viewpoints of the page that shows its result. PyTorch is not imported.
"""

import math
import operator
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge, Le
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StringConstraints, create_model, field_validator

from sgsst_core.constants import NEAR
from sgsst_core.errors import SettingsError
from sgsst_core.files.formats.spz import SpzAxes
from sgsst_core.scene.rendering import MAX_EPS2D, RenderMode
from sgsst_core.settings import (
    BY_PRESET,
    COLOR_SYNTAX,
    MAX_RESOLUTION,
    OR_STRENGTH,
    Color,
    Near,
    Option,
    PresetName,
    Resolution,
    Settings,
    checked,
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
        description="Create N views around the scene instead of reading camera files; auto: 43, or 22 above a ground. "
        "They form rings at up to three elevations.",
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


#: Maximum number of images of a style. More are probably a mistake.
MOST_STYLE_IMAGES = 16
_WEIGHTED = re.compile(r"(?P<file>.+):(?P<weight>[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)", re.DOTALL)


@dataclass(frozen=True)
class StyleFile:
    """File of a style image, and its weight relative to the other images of the style (above 0)."""

    path: Path
    weight: float = 1.0


def path_or_url(value: str | Path) -> Path | str:
    """Return the path of a local file, or an http or https URL, or the path of a job's file in the API, unchanged."""
    remote = ("http://", "https://", "/v1/jobs/")
    return value if isinstance(value, str) and value.lower().startswith(remote) else Path(value)


def split_weight(text: str, exists: Callable[[Path], bool] = Path.exists) -> tuple[str, float]:
    """Return the file and weight of FILE or FILE:WEIGHT; see `parse_style`. The weight is 1 if there is none."""
    match = _WEIGHTED.fullmatch(text)
    return (text, 1.0) if match is None or exists(Path(text)) else (match["file"], float(match["weight"]))


def parse_style(text: str, exists: Callable[[Path], bool] = Path.exists) -> StyleFile:
    """Parse FILE or FILE:WEIGHT.

    If a file named like the whole text exists, the text is its path, even if it ends in `:WEIGHT`.

    Raises:
        SettingsError: If the weight is not finite or not above 0.
    """
    file, weight = split_weight(text, exists)
    if not (math.isfinite(weight) and weight > 0):
        given = text.rpartition(":")[2]
        raise SettingsError(f"Style image {text}: the weight must be a finite number above 0, not {given}.")
    return StyleFile(Path(file), weight)


def parse_styles(texts: Sequence[str]) -> tuple[StyleFile, ...]:
    """Parse all images of a style; see `parse_style`.

    Raises:
        SettingsError: If a weight is invalid, or there are no images or too many.
    """
    if not 1 <= len(texts) <= MOST_STYLE_IMAGES:
        raise SettingsError(f"There are {len(texts)} style images. Give between 1 and {MOST_STYLE_IMAGES}.")
    return tuple(parse_style(text) for text in texts)


#: Text without control characters: it is shown in terminals, and some databases cannot store zero bytes.
NO_CONTROLS = r"^[^\x00-\x1f\x7f-\x9f]*$"
#: Maximum number of painted views of a job.
MOST_PAINTED = 16
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Row = Annotated[list[_Finite], Field(min_length=4, max_length=4)]


class CameraParameters(BaseModel):
    """Pinhole camera in JSON. Pixel centers are at +0.5; x points right, y down, z forward."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"width": 960, "height": 600, "fx": 700.0, "fy": 700.0, "cx": 480.0, "cy": 300.0}
                | {"world_to_camera": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 3.0]]}
            ]
        },
    )

    width: int = Field(ge=1, le=MAX_RESOLUTION, description="Width in pixels.")
    height: int = Field(ge=1, le=MAX_RESOLUTION, description="Height in pixels.")
    fx: _Finite = Field(gt=0, description="Horizontal focal length in pixels.")
    fy: _Finite = Field(gt=0, description="Vertical focal length in pixels.")
    cx: _Finite = Field(description="Horizontal position of the principal point in pixels.")
    cy: _Finite = Field(description="Vertical position of the principal point in pixels.")
    world_to_camera: Annotated[list[_Row], Field(min_length=3, max_length=4)] = Field(
        description="Rows of the rigid transform, 3x4 or 4x4."
    )


class PaintedOptions(BaseModel):
    """View of a painted file in JSON. Without view and camera, a PNG states both in its text chunk `sgsst-view`."""

    model_config = ConfigDict(frozen=True, extra="forbid", json_schema_extra={"examples": [{"view": "orbit_0000"}]})

    view: Annotated[str, Field(min_length=1, max_length=1000, pattern=NO_CONTROLS)] | None = Field(
        None, description="Name of a camera of the job; of `camera`, if that is given."
    )
    camera: CameraParameters | None = Field(None, description="Camera of any viewpoint. Default: the one named `view`.")


@dataclass(frozen=True)
class PaintedFile:
    """File with a painted view, and what is known about the view."""

    path: Path
    options: PaintedOptions = field(default_factory=PaintedOptions)

    @staticmethod
    def parse(text: str) -> "PaintedFile":
        """Parse FILE or NAME=FILE. If a file named like the whole text exists, the text is its path."""
        name, equals, path = text.partition("=")
        if not equals or Path(text).exists():
            return PaintedFile(Path(text))
        return PaintedFile(Path(path), checked(PaintedOptions, {"view": name}))


#: Selections that need no file, for help texts. Those with a file are `mask=` and `masks=`.
SHAPES = (
    "box=X0,Y0,Z0,X1,Y1,Z1, sphere=X,Y,Z,R, half-space=A,B,C,D (where A x + B y + C z >= D), "
    "property=NAME>VALUE (also >=, <, <=, =, !=)"
)
#: Name of the region of all Gaussians that no selection contains.
REST = "rest"
#: Maximum number of regions, the rest excluded.
MOST_REGIONS = 16
#: Maximum weight of a region. Larger ones can raise the gradient beyond `LARGEST_GRADIENT`.
MOST_REGION_WEIGHT = 1e6
#: Name of a region, which is a label: any text.
RegionName = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=64, pattern=NO_CONTROLS)]
_COMPARISON = re.compile(r"(?P<name>[^<>=!]+)(?P<sign>>=|<=|!=|>|<|=)(?P<value>.+)", re.DOTALL)
_COUNTS = {"box": 6, "sphere": 4, "half-space": 4}
Kind = Literal["box", "sphere", "half-space", "property", "mask", "masks"]
_HOW = "Use box=, sphere=, half-space=, property=, mask= or masks=; see `sgsst stylize --help`."


@dataclass(frozen=True)
class Selection:
    """Selection of a region's Gaussians.

    Attributes:
        text: SPEC of `--region` as the user gave it.
        numbers: Numbers of a box, sphere or half-space, or the value that a property is compared with.
        name, sign: Property and comparison operator of a property selection.
    """

    kind: Kind
    text: str
    numbers: tuple[float, ...] = ()
    name: str = ""
    sign: str = ""
    path: Path | None = None


@dataclass(frozen=True)
class RegionRequest:
    """Request for one region, as `RegionOptions` describes; without a selection, it is the rest."""

    name: str
    selection: Selection | None = None
    styles: tuple[StyleFile, ...] = ()
    weight: float = 1.0
    freeze: bool = False
    content_weight: float | None = None


class RegionOptions(BaseModel):
    """One region in JSON."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={"examples": [{"name": "face", "select": "sphere=0,1.4,0,0.3", "style": "wave.jpg"}]},
    )

    name: RegionName = Field(
        description="Name of the region; `rest` stands for the Gaussians that no region selects.", examples=["face"]
    )
    select: Annotated[str, Field(max_length=1000)] | None = Field(
        None,
        description=f"Selection of its Gaussians; omitted for the rest: {SHAPES}, mask=NAME (an uploaded `mask` file "
        "with a flag per Gaussian) or masks=FOLDER (the uploaded `mask` images in that folder: masks of views, white "
        "inside).",
        examples=["half-space=0,1,0,0.5"],
    )
    style: (
        Annotated[str, Field(min_length=1, max_length=300)]
        | Annotated[
            list[Annotated[str, Field(min_length=1, max_length=300)]], Field(min_length=1, max_length=MOST_STYLE_IMAGES)
        ]
        | None
    ) = Field(
        None,
        description="Name of the uploaded `style` file with the region's style, which is then not part of the job's "
        "style; a list of NAME:WEIGHT mixes several. Default: the job's style.",
        examples=["wave.jpg"],
    )
    weight: float = Field(
        1.0, gt=0, le=MOST_REGION_WEIGHT, allow_inf_nan=False, description="Weight of the region's style in the loss."
    )
    freeze: bool = Field(False, description="Freeze the region: its colors stay bit-identical.")
    content_weight: Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False), OR_STRENGTH] | None = Field(
        None,
        description="Weight of the content term in the region, or a style strength: light, balanced or strong. "
        "Default: the job's.",
        examples=["balanced"],
    )

    @property
    def style_texts(self) -> list[str]:
        """Return the style files as they were given."""
        return [] if self.style is None else [self.style] if isinstance(self.style, str) else self.style

    def request(self, exists: Callable[[Path], bool] = Path.exists) -> RegionRequest:
        """Convert these options to a request.

        Args:
            exists: Function that returns whether a file exists; see `parse_style`.

        Raises:
            SettingsError: If the selection or a style is invalid.
        """
        selection = None if self.select is None else parse_selection(self.select, f"region {self.name!r}")
        styles = tuple(parse_style(text, exists) for text in self.style_texts)
        return RegionRequest(self.name, selection, styles, self.weight, self.freeze, self.content_weight)


def parse_selection(text: str, where: str) -> Selection:
    """Parse a SPEC.

    Args:
        where: Option or region that the SPEC belongs to, for error messages.

    Raises:
        SettingsError: If it is not a valid SPEC.
    """
    kind, separator, value = text.partition("=")
    if separator and kind in _COUNTS:
        return Selection(kind, text, _numbers(kind, value, where))  # type: ignore[arg-type]
    if separator and value and kind in ("mask", "masks"):
        return Selection(kind, text, path=Path(value))  # type: ignore[arg-type]
    if separator and kind == "property":
        match = _COMPARISON.fullmatch(value)
        if match is None:
            raise SettingsError(f"{where}: {text!r} is not a comparison. Give one such as property=opacity>0.5.")
        return Selection(
            "property", text, (_number(match["value"], text, where),), match["name"].strip(), match["sign"]
        )
    raise SettingsError(f"{where}: {text!r} is not a known selection. {_HOW}")


def _numbers(kind: str, value: str, where: str) -> tuple[float, ...]:
    parts = value.split(",")
    if len(parts) != _COUNTS[kind]:
        raise SettingsError(
            f"{where}: {kind}={value} has {len(parts)} numbers. Give {_COUNTS[kind]}, separated by commas."
        )
    numbers = tuple(_number(part, value, where) for part in parts)
    if kind == "sphere" and numbers[3] <= 0:
        raise SettingsError(f"{where}: the sphere's radius is {numbers[3]:g}. It must be greater than 0.")
    if kind == "half-space" and not any(numbers[:3]):
        raise SettingsError(f"{where}: half-space={value} has no direction. A, B and C must not all be 0.")
    return numbers


def _number(text: str, whole: str, where: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise SettingsError(f"{where}: {text!r} in {whole!r} is not a finite number. Give one.")
    return number


def region_options(
    regions: Sequence[str],
    styles: Sequence[str],
    weights: Sequence[str],
    frozen: Sequence[str],
    content_weights: Sequence[str] = (),
) -> tuple[RegionOptions, ...]:
    """Parse the region options of the command line.

    Args:
        regions: Texts `NAME:SPEC`.
        styles: Texts `NAME=FILE[:WEIGHT]`; several styles of one region are mixed.
        weights: Texts `NAME=WEIGHT`.
        frozen: Names of regions whose colors stay unchanged.
        content_weights: Texts `NAME=WEIGHT`, where the weight may be a style strength.

    Raises:
        SettingsError: If a text is malformed, a name is used twice, or a region is unknown.
    """
    by_name: dict[str, dict[str, Any]] = {}
    for text in regions:
        name, separator, spec = text.partition(":")
        name = name.strip()
        if not separator or not name or "=" in name:
            raise SettingsError(f"--region {text}: expected NAME:SPEC, such as face:sphere=0,1.4,0,0.3. {_HOW}")
        if name in by_name:
            raise SettingsError(f"--region {text}: a region {name} already exists. Give each region a unique name.")
        by_name[name] = {"name": name, "select": spec}
    known, files = dict.fromkeys([*by_name, REST]), defaultdict[str, list[str]](list)
    fields = {"style": styles, "weight": weights, "content_weight": content_weights, "freeze": frozen}
    for field_name, text in ((field_name, text) for field_name, texts in fields.items() for text in texts):
        option = f"--region-{field_name.replace('_', '-')} {text}"
        name, separator, value = text.partition("=")
        if name not in known:
            raise SettingsError(
                f"{option}: there is no region {name!r}. Use one of {', '.join(known)}, or add it with --region."
            )
        if field_name == "freeze" and separator:
            raise SettingsError(f"{option}: expected NAME. Give only the region's name, or omit the option.")
        if field_name != "freeze" and not value:
            raise SettingsError(f"{option}: expected NAME=VALUE. Give the value after the region's name.")
        values = by_name.setdefault(name, {"name": name})
        if field_name == "style":
            files[name].append(value)
        else:
            values[field_name] = value or True
    return tuple(
        checked(RegionOptions, values).model_copy(update={"style": files[name] or None})
        for name, values in by_name.items()
    )


def region_requests(
    options: Iterable[RegionOptions], exists: Callable[[Path], bool] = Path.exists
) -> tuple[RegionRequest, ...]:
    """Convert the options of all regions to requests, the rest first; see `RegionOptions.request`.

    Raises:
        SettingsError: If a region is invalid, there are too many regions, or two have the same name.
    """
    requests = [each.request(exists) for each in options]
    names = [region.name for region in requests]
    for region in requests:
        if len(region.styles) > MOST_STYLE_IMAGES:
            raise SettingsError(
                f"Region {region.name!r} has {len(region.styles)} style images. At most {MOST_STYLE_IMAGES} are "
                "allowed."
            )
        if names.count(region.name) > 1:
            raise SettingsError(f"There are two regions {region.name!r}. Give each region a unique name.")
        if (region.name == REST) != (region.selection is None):
            why = "needs a SPEC" if region.name != REST else "is what no other region selects, and takes no SPEC"
            raise SettingsError(f"Region {region.name!r} {why}. {_HOW}")
        if region.freeze and (region.styles or region.weight != 1 or region.content_weight is not None):
            raise SettingsError(
                f"Region {region.name!r} is frozen, so it cannot have a style or weight. Remove one or the other."
            )
    rest = [region for region in requests if region.name == REST]
    if (selecting := len(requests) - len(rest)) > MOST_REGIONS:
        raise SettingsError(f"There are {selecting} regions. At most {MOST_REGIONS} are allowed.")
    return (*rest, *(region for region in requests if region.name != REST))


#: Maximum numbers of named viewpoints, and of characters of a name.
MOST_VIEWPOINTS, MOST_VIEWPOINT_NAME = 12, 200
#: Largest deviation of a viewpoint's axes from a rotation.
_AXES_TOLERANCE = 1e-3
_Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Focal = Annotated[float, Field(gt=0, le=1e7)]
_Side = Annotated[int, Field(ge=1, le=65_535)]
_EXAMPLE: dict[str, Any] = {
    "name": "front",
    "position": [0.0, 0.0, -3.0],
    "axes": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "fx": 800.0,
    "fy": 800.0,
    "width": 1200,
    "height": 800,
}


class Viewpoint(BaseModel):
    """Pose of a page's 3D view: a pinhole camera with its principal point in the middle."""

    model_config = ConfigDict(frozen=True, extra="forbid", json_schema_extra={"examples": [_EXAMPLE]})

    name: str = Field("", max_length=MOST_VIEWPOINT_NAME, pattern=NO_CONTROLS)
    position: _Vector = Field(description="Position in the world.")
    axes: Annotated[list[_Vector], Field(min_length=3, max_length=3)] = Field(
        description="Directions of right, down and forward in the world: the rows of a rotation, within 1e-3."
    )
    fx: _Focal = Field(description="Focal length in pixels.")
    fy: _Focal = Field(description="Focal length in pixels.")
    width: _Side = Field(description="Width in pixels. The page shows the whole frame at its own size.")
    height: _Side = Field(description="Height in pixels.")

    @field_validator("axes")
    @classmethod
    def _check_axes(cls, axes: list[list[float]]) -> list[list[float]]:
        (a, b, c), (d, e, f), forward = axes
        products = [sum(map(operator.mul, first, second)) for first in axes for second in axes]
        across = sum(map(operator.mul, (b * f - c * e, c * d - a * f, a * e - b * d), forward))
        errors = [abs(value - (at % 4 == 0)) for at, value in enumerate(products)]
        if not all(error <= _AXES_TOLERANCE for error in (*errors, abs(across - 1))):
            raise ValueError("must be orthogonal unit vectors: right, down and forward")
        return axes


class Viewpoints(BaseModel):
    """Viewpoints of the page that shows a result."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", json_schema_extra={"examples": [{"start": None, "named": [_EXAMPLE]}]}
    )

    start: Viewpoint | None = Field(
        None, description="Viewpoint at which the page opens. Null: the first camera; without cameras, the whole scene."
    )
    named: list[Viewpoint] = Field(
        default_factory=list,
        max_length=MOST_VIEWPOINTS,
        description="Viewpoints to jump to, in the order of their keys and of the path through them.",
    )

    @field_validator("named")
    @classmethod
    def _check_names(cls, named: list[Viewpoint]) -> list[Viewpoint]:
        names = [viewpoint.name for viewpoint in named]
        if "" in names or len({*names}) < len(names):
            raise ValueError("must have names, each of them once")
        return named
