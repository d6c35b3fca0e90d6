"""How fields of a pydantic model are offered as options: on the command line, over HTTP, in the reference.

Type, bounds, default and help text are the field's own (`Field(..., ge=..., description=...)`). What pydantic has no
word for stands beside them in `Annotated[..., Option(...)]`.
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
    """What a field is to its user, beside what pydantic knows of it.

    Attributes:
        unit: of a quantity; empty for words and switches.
        metavar: stands for the value in a command's help, and in the help text; empty for the type's name.
        flags: on the command line, such as "--warm-start/--cold-start"; empty for those made from the name.
        default: the default in words, where it is None or says little by itself.
        name: that users know the field by; empty for its own.
        instead: the option that stands for this field, which is none itself; empty for an option.
    """

    unit: str = ""
    metavar: str = ""
    flags: str = ""
    default: str = ""
    name: str = ""
    instead: str = ""

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Unit and default are told in JSON schemas too, so in the OpenAPI document."""
        extra = {"x-unit": self.unit, "x-default": self.default}
        return handler(schema) | {name: value for name, value in extra.items() if value}


@dataclass(frozen=True)
class Declared:
    """A field of a model, as an option.

    Attributes:
        field: its name in the model.
        info: what pydantic knows of it.
        option: the rest.
    """

    field: str
    info: FieldInfo
    option: Option

    @property
    def name(self) -> str:
        """The name that users know it by."""
        return self.option.name or self.field

    @property
    def help(self) -> str:
        """What it does, in a sentence."""
        return self.info.description or ""

    @property
    def limits(self) -> list[Any]:
        """What bounds a number; of one that may be a word instead, this stands inside the union."""
        inside = [kind.__metadata__ for kind in get_args(self.info.annotation) if get_origin(kind) is Annotated]
        return [item for item in itertools.chain(self.info.metadata, *inside) if isinstance(item, Ge | Gt | Le | Lt)]

    @property
    def bounds(self) -> str:
        """The values that a number may have, such as "0<=x<1" or "x>=1"; empty where it may have all."""
        low = high = above = ""
        for item in self.limits:
            if isinstance(item, Ge | Gt):
                bound, sign = (item.ge, "=") if isinstance(item, Ge) else (item.gt, "")
                low, above = f"{_plain(bound)}<{sign}", f"x>{sign}{_plain(bound)}"
            else:
                high = f"<={_plain(item.le)}" if isinstance(item, Le) else f"<{_plain(item.lt)}"
        return f"{low}x{high}" if high else above

    def text(self, value: object) -> str:
        """A value in words: the default by its own ones."""
        if self.option.default and value == self.info.default:
            return self.option.default
        return _plain(value)


def declared(model: type[BaseModel]) -> dict[str, Declared]:
    """The fields of a model that are options, by the name that users know them by."""
    found = [
        Declared(field, info, next((item for item in info.metadata if isinstance(item, Option)), Option()))
        for field, info in model.model_fields.items()
    ]
    return {each.name: each for each in found if not each.option.instead}


def _plain(value: object) -> str:
    """A value without digits that say nothing."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)
