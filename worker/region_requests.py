"""Region options of the command line and of JSON, converted to the same requests. Imports no PyTorch."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from sgsst_core.errors import SettingsError
from sgsst_core.settings import OR_STRENGTH, checked, parse_strength
from worker.styles import MOST_STYLE_IMAGES, StyleFile, parse_style

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
#: Text without control characters: it is shown in terminals, and some databases cannot store zero bytes.
NO_CONTROLS = r"^[^\x00-\x1f\x7f-\x9f]*$"
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
    by_name: dict[str, RegionOptions] = {}
    for text in regions:
        name, separator, spec = text.partition(":")
        name = name.strip()
        if not separator or not name or "=" in name:
            raise SettingsError(f"--region {text}: expected NAME:SPEC, such as face:sphere=0,1.4,0,0.3. {_HOW}")
        if name in by_name:
            raise SettingsError(f"--region {text}: a region {name} already exists. Give each region a unique name.")
        by_name[name] = checked(RegionOptions, {"name": name, "select": spec})
    given = set(by_name)

    def known(name: str, option: str) -> RegionOptions:
        if name != REST and name not in given:
            names = ", ".join([*by_name, REST]) if REST not in by_name else ", ".join(by_name)
            raise SettingsError(f"{option}: there is no region {name!r}. Use one of {names}, or add it with --region.")
        return by_name.get(name, RegionOptions(name=REST))

    for text in styles:
        name, _, file = text.partition("=")
        region = known(name, f"--region-style {text}")
        if not file:
            raise SettingsError(f"--region-style {text}: expected NAME=FILE. Give the path of a style image.")
        by_name[name] = region.model_copy(update={"style": [*region.style_texts, file]})
    for text in weights:
        name, _, value = text.partition("=")
        region = known(name, f"--region-weight {text}")
        weight = _number(value, text, "--region-weight")
        if not 0 < weight <= MOST_REGION_WEIGHT:
            raise SettingsError(f"--region-weight {text}: the weight must be greater than 0 and at most 1,000,000.")
        by_name[name] = region.model_copy(update={"weight": weight})
    for text in content_weights:
        name, _, value = text.partition("=")
        region = known(name, f"--region-content-weight {text}")
        by_name[name] = region.model_copy(update={"content_weight": _content_weight(value, text)})
    for name in frozen:
        by_name[name] = known(name, f"--region-freeze {name}").model_copy(update={"freeze": True})
    return tuple(by_name.values())


def _content_weight(value: str, text: str) -> float:
    try:
        weight = parse_strength(value)
    except ValueError as error:
        raise SettingsError(f"--region-content-weight {text}: {error}") from error
    if not 0 <= weight <= 1e12:
        raise SettingsError(f"--region-content-weight {text}: the weight must be at least 0 and at most 1e12.")
    return weight


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
    selecting = len([name for name in names if name != REST])
    if selecting > MOST_REGIONS:
        raise SettingsError(f"There are {selecting} regions. At most {MOST_REGIONS} are allowed.")
    rest = next((region for region in requests if region.name == REST), None)
    return (*([rest] if rest else []), *(region for region in requests if region.name != REST))
