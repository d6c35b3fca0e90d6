"""Declaration of pydantic fields as options of the command line, the HTTP API and the reference documentation.

Type, bounds, default and help text are those of the field (`Field(..., ge=..., description=...)`). Properties that
pydantic cannot express are added by `Annotated[..., Option(...)]`.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails

#: Parts of an error's location that name a type of a union.
_MEMBER = re.compile(r"constrained-\w+|\w+\[.*\]")
#: Content weight of each named style strength, chosen on the trade-off curve of style and content (docs/quality.md).
STRENGTHS: dict[str, float] = {"light": 3e4, "balanced": 1e4, "strong": 1.0}
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
#: Syntax of `parse_color`, for help texts.
COLOR_SYNTAX = ": black, white, or R,G,B from 0 to 255."
_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def unknown_text(name: str, known: Iterable[str]) -> str:
    """Return the message for an unknown option or parameter, with a known one that differs by a slip of the keys."""
    similar = difflib.get_close_matches(name, known, 1, cutoff=0.75)
    return "is not a parameter." + (f" Did you mean {similar[0]!r}?" if similar else "")


@dataclass(frozen=True)
class Option:
    """Presentation of a field to users, apart from what the pydantic field declares.

    Attributes:
        unit: Unit of the value; empty for enumerations and switches.
        metavar: Placeholder for the value in help texts; empty to use the name of the type.
        flags: Command-line flags, such as "--warm-start/--cold-start"; empty to derive them from the name.
        default: Description of the default if its value is None or not self-explanatory; empty to display the value.
        name: Name shown to users; empty for the field's own.
        instead: Name of the option that sets this field, which is then not an option itself; empty if it is an option.
        parse: Parser of command-line text, for values that are more than a number or a word, such as those below. A
            parser raises a ValueError with a message for the user.
        syntax: Command-line syntax that `parse` accepts; replaces the final period of the help text.
        presets: Default for each preset, if it depends on the preset.
    """

    unit: str = ""
    metavar: str = ""
    flags: str = ""
    default: str = ""
    name: str = ""
    instead: str = ""
    parse: Callable[[str], object] | None = None
    syntax: str = ""
    presets: Mapping[str, str] = field(default_factory=dict)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Add unit and default to JSON schemas, and thereby to the OpenAPI document."""
        extra = {"x-unit": self.unit, "x-default": self.default, "x-presets": dict(self.presets)}
        return handler(schema) | {name: value for name, value in extra.items() if value}


@dataclass(frozen=True)
class Declared:
    """Model field that is offered as an option."""

    field: str
    info: FieldInfo
    option: Option

    @property
    def name(self) -> str:
        """Name shown to users."""
        return self.option.name or self.field

    @property
    def help(self) -> str:
        """Help text."""
        return self.info.description or ""

    @property
    def limits(self) -> list[Any]:
        """Bounds of a number. If the field also accepts a word, they are taken from the members of its union type."""
        inside = [kind.__metadata__ for kind in get_args(self.info.annotation) if get_origin(kind) is Annotated]
        return [item for item in itertools.chain(self.info.metadata, *inside) if isinstance(item, Ge | Gt | Le | Lt)]

    @property
    def bounds(self) -> str:
        """Range of a number, such as "0<=x<1" or "x>=1"; empty if unbounded."""
        low = high = above = ""
        for item in self.limits:
            if isinstance(item, Ge | Gt):
                bound, sign = (item.ge, "=") if isinstance(item, Ge) else (item.gt, "")
                low, above = f"{_plain(bound)}<{sign}", f"x>{sign}{_plain(bound)}"
            else:
                high = f"<={_plain(item.le)}" if isinstance(item, Le) else f"<{_plain(item.lt)}"
        return f"{low}x{high}" if high else above

    def text(self, value: object) -> str:
        """Return a value as text; for the default value, `Option.default` if there is one."""
        if self.option.default and value == self.info.default:
            return self.option.default
        return _plain(value)


def reason(error: ErrorDetails) -> str:
    """Return pydantic's reason why a value is invalid, or the message of our own validators, for users."""
    return error["msg"].removeprefix("Value error, ")


def merged(errors: Iterable[ErrorDetails]) -> list[ErrorDetails]:
    """Return one error for each invalid value; pydantic has one for each type that the value could have."""
    by_loc: dict[tuple[int | str, ...], ErrorDetails] = {}
    for error in errors:
        unknown = error["type"] == "extra_forbidden"  # the last part is a name that a client has chosen
        loc = error["loc"] if unknown else tuple(part for part in error["loc"] if not _MEMBER.fullmatch(str(part)))
        if loc not in by_loc:
            by_loc[loc] = {**error, "loc": loc}
        elif by_loc[loc]["type"].endswith(("_parsing", "_type")):  # otherwise it has the first type, out of bounds
            by_loc[loc]["msg"] += f", or {error['msg'].removeprefix('Input should be ')}"
    return list(by_loc.values())


def declared(model: type[BaseModel]) -> dict[str, Declared]:
    """Return the fields of a model that are options, keyed by the name shown to users."""
    options = [
        Declared(field, info, next((item for item in info.metadata if isinstance(item, Option)), Option()))
        for field, info in model.model_fields.items()
    ]
    return {each.name: each for each in options if not each.option.instead}


def _plain(value: object) -> str:
    """Return a value as text without redundant digits."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


def parse_color(text: str) -> tuple[float, float, float]:
    """Return RGB in 0..1 from "black", "white" or three numbers from 0 to 255: "40,40,48"."""
    if text.lower() in _COLORS:
        return _COLORS[text.lower()]
    try:
        red, green, blue = (float(part) / 255 for part in text.split(","))
    except ValueError:
        red = math.nan
    if not (0 <= red <= 1 and 0 <= green <= 1 and 0 <= blue <= 1):
        raise ValueError(
            f"{text!r} is not a color. Give black, white or three numbers from 0 to 255, such as 40,40,48."
        )
    return red, green, blue


def parse_bytes(text: str) -> int:
    """Return bytes from "8GB", "512 MB", "6GiB" or a plain number."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?I?)B?", text.strip().upper())
    if not match or match[2] not in _UNITS or not (size := int(float(match[1]) * _UNITS[match[2]])):
        raise ValueError(f"{text!r} is not an amount of memory. Give one such as 8GB or 512MB.")
    return size


#: Seconds per unit of a time.
_SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


def parse_seconds(text: str) -> float:
    """Return seconds from "90s", "5m", "1.5h" or a plain number."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?|\.\d+)\s*([a-z]*)", text.strip().lower())
    if not match or match[2] not in _SECONDS:
        raise ValueError(f"{text!r} is not a time. Give one such as 90s, 5m or 1h.")
    return float(match[1]) * _SECONDS[match[2]]


def parse_strength(text: str) -> float:
    """Return a content weight from "light", "balanced", "strong" or a number."""
    if text.lower() in STRENGTHS:
        return STRENGTHS[text.lower()]
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a weight. Give a number or one of {', '.join(STRENGTHS)}.") from None


def parse_growth(text: str) -> float | str:
    """Return the factor of a refinement, or "auto"."""
    if text.lower() == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a factor. Give a number or auto.") from None


def parse_weights(text: str) -> tuple[float, ...]:
    """Return weights of scales from "1,0.5,0,1"."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(
            f"{text!r} is not a list of weights. Give numbers separated by commas, such as 1,0.5,0,1."
        ) from None
