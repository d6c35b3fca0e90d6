"""Declaration of pydantic fields as options of the command line, the HTTP API and the reference.

Type, bounds, default and help text are those of the field (`Field(..., ge=..., description=...)`). What pydantic cannot
express is added by `Annotated[..., Option(...)]`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

#: Former names of options and parameters, with their present ones. Only error messages and stored jobs use them.
RENAMED = {
    "keep": "freeze",
    "keep_colours": "preserve_colors",
    "keep_everything": "compute_everything",
    "kept_weights": "cached_weights",
    "region_keep": "region_freeze",
    "revive": "clamp_aware_gradient",
    "sh_fade": "sh_attenuation",
    "surround": "training_background",
}


def renamed_hint(name: str) -> str:
    """Return what to write instead of a former option or parameter; empty if the name was never one.

    Args:
        name: Parameter ("sh_fade", "regions.0.keep") or flag ("--sh-fade", "--no-revive").
    """
    flag = name.startswith("--")
    plain = name.removeprefix("--").removeprefix("no-").replace("-", "_").rpartition(".")[2]
    new = RENAMED.get(plain, "")
    return f"it is called {'--' + new.replace('_', '-') if flag else new} now" if new else ""


@dataclass(frozen=True)
class Option:
    """Presentation of a field to users, in addition to what pydantic knows.

    Attributes:
        unit: Unit of a quantity; empty for words and switches.
        metavar: Placeholder of the value in a command's help and in the help text; empty for the name of the type.
        flags: Command-line flags, such as "--warm-start/--cold-start"; empty to derive them from the name.
        default: Default as text, if it is None or not self-explanatory.
        name: Name shown to users; empty for the field's own.
        instead: Option that represents this field, which is then not an option itself; empty if the field is an option.
    """

    unit: str = ""
    metavar: str = ""
    flags: str = ""
    default: str = ""
    name: str = ""
    instead: str = ""

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Add unit and default to JSON schemas, and thereby to the OpenAPI document."""
        extra = {"x-unit": self.unit, "x-default": self.default}
        return handler(schema) | {name: value for name, value in extra.items() if value}


@dataclass(frozen=True)
class Declared:
    """Model field that is offered as an option.

    Attributes:
        field: Name in the model.
        info: Field information from pydantic.
        option: Presentation to users.
    """

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
        """Bounds of a number. If a word is accepted too, they are inside the union type."""
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
        """Return a value as text; for the default, its text in the declaration."""
        if self.option.default and value == self.info.default:
            return self.option.default
        return _plain(value)


def declared(model: type[BaseModel]) -> dict[str, Declared]:
    """Return the fields of a model that are options, by the name shown to users."""
    found = [
        Declared(field, info, next((item for item in info.metadata if isinstance(item, Option)), Option()))
        for field, info in model.model_fields.items()
    ]
    return {each.name: each for each in found if not each.option.instead}


def _plain(value: object) -> str:
    """Return a value as text without redundant digits."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)
