"""Settings of a stylization, their presets, and their declaration as options.

Command line, HTTP API and reference derive from the fields: type, bounds, default and help text are those of the field
(`Field(..., ge=..., description=...)`). Properties that pydantic cannot express are added by
`Annotated[..., Option(...)]`.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Annotated, Any, Literal, Self, TypeVar, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
)
from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, core_schema

from sgsst_core.constants import COARSEST_SHORTER_SIDE, NEAR
from sgsst_core.errors import SettingsError

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


@cache
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


def parse_weights(text: str) -> tuple[float, ...]:
    """Return weights of scales from "1,0.5,0,1"."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(
            f"{text!r} is not a list of weights. Give numbers separated by commas, such as 1,0.5,0,1."
        ) from None


PresetName = Literal["preview", "standard", "paper"]
#: Precision of the feature network.
PlannedPrecision = Literal["float32", "winograd", "tf32", "bfloat16", "float16"]
Precision = Literal["auto", "float32", "winograd", "tf32", "bfloat16", "float16"]
#: Precisions whose errors are those of float32.
WHOLE_FLOAT32: tuple[PlannedPrecision, ...] = ("float32", "winograd")
PositionWeights = Literal["auto", "on", "off"]
CachedWeights = Literal["auto", "float32", "half", "none"]
FeatureScale = Literal["paper", "even"]
PreservedColors = Literal["no", "match", "luminance"]
StyleLossName = Literal["sos", "nnfm", "mixed"]
#: Background of the Gaussians in a step: `Settings.background`, a uniform random color, or the color of a style pixel.
PlannedBackground = Literal["background", "random", "palette"]
TrainingBackground = Literal["auto", "background", "random", "palette"]
#: Prefix of the description of a default that depends on the preset.
BY_PRESET = "by preset"
M = TypeVar("M", bound=BaseModel)
#: Settings that a time budget, or the plan of a job on several ranks, chooses if they are not given.
_CHOSEN = ("max_resolution", "steps_coarse", "steps_sos", "learning_rate_end", "views_per_step")


#: Upper limit of a view's longer side in pixels: well beyond the paper's 5187, and low enough that a typo does not
#: exhaust memory.
MAX_RESOLUTION = 16384
#: Maximum number of steps, and maximum weight. Larger values are assumed to be typos.
_MAX_STEPS, _MAX_WEIGHT = 10_000_000, 1e12

Fraction = Annotated[float, Field(ge=0, le=1)]
Near = Annotated[
    float,
    Option(unit="scene units"),
    Field(gt=0, allow_inf_nan=False, description="Distance of the near plane."),
]
Resolution = Annotated[
    int | None,
    Option(unit="pixels", name="resolution", default="the cameras' own"),
    Field(ge=1, le=MAX_RESOLUTION, description="Longer side of every view in pixels."),
]


#: Factor of `Settings.refine`.
RefineFactor = Annotated[float, Ge(1), Le(16)]
#: Maximum growth with `refine` "auto".
_AUTO_GROWTH = 2.0
ScaleWeight = Annotated[float, Field(ge=0, le=_MAX_WEIGHT, allow_inf_nan=False)]


def _some_weight(weights: tuple[float, ...] | None) -> tuple[float, ...] | None:
    """Check that at least one scale has a weight. An empty tuple means equal weights."""
    if weights and not any(weights):
        raise ValueError("no scale has a weight")
    return weights


class _OrText:
    """Annotation that accepts text in place of a value, also in JSON schemas.

    Args:
        parse: Parser of the text; raises a ValueError for invalid text.
        schema: JSON schema of the text.
    """

    def __init__(self, parse: Callable[[str], object], schema: dict[str, Any]) -> None:
        self._parse = parse
        self._schema = {"type": "string", **schema}

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self._value, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        values = handler(schema)
        kinds = values.pop("anyOf", None) or [{name: values.pop(name) for name in list(values) if name != "default"}]
        return {**values, "anyOf": [*kinds, self._schema]}

    def _value(self, value: object) -> object:
        return self._parse(value) if isinstance(value, str) else value


#: Color as three fractions. Text is parsed as on the command line.
Color = Annotated[
    tuple[Fraction, Fraction, Fraction],
    _OrText(parse_color, {"description": "black, white, or R,G,B from 0 to 255", "examples": ["40,40,48"]}),
]


#: Annotation of a content weight that accepts a style strength as text.
OR_STRENGTH = _OrText(lambda text: STRENGTHS.get(text, text), {"enum": list(STRENGTHS)})


class Settings(BaseModel):
    """Everything that determines a result, apart from scene, cameras, style and photos.

    Each field is declared only here: command-line options, API parameters and the reference in docs/options.md are
    derived from it. Names and order are part of a checkpoint's fingerprint, so renaming or adding a field invalidates
    existing checkpoints.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: PresetName = Field("standard", description="Preset that sets the defaults of the options below.")
    steps_coarse: Annotated[int, Option(unit="steps", metavar="N")] = Field(
        ge=0, le=_MAX_STEPS, description="Steps of phase 1, on the coarsest scale only."
    )
    steps_sos: Annotated[int, Option(unit="steps", metavar="N")] = Field(
        ge=0, le=_MAX_STEPS, description="Steps of phase 2, on all scales."
    )
    learning_rate: Annotated[float, Option(unit="color units per step", metavar="R")] = Field(
        gt=0, le=100, allow_inf_nan=False, description="Learning rate of Adam; constant if given."
    )
    learning_rate_end: Annotated[float, Option(unit="as learning_rate", instead="learning_rate")] = Field(
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Final learning rate of Adam, reached by exponential decay; higher by default with fewer steps.",
    )
    content_weight: Annotated[
        float,
        OR_STRENGTH,
        Option(
            unit="factor or strength",
            metavar="W",
            parse=parse_strength,
            syntax=" (" + ", ".join(f"{word} {weight:g}" for word, weight in STRENGTHS.items()) + ").",
        ),
    ] = Field(
        1.0,
        ge=0,
        le=_MAX_WEIGHT,
        allow_inf_nan=False,
        description="Weight of the content term, or a style strength: light, balanced or strong; 0 disables the term.",
    )
    feature_scale: FeatureScale = Field(
        "even",
        description="Weighting of the network's layers; paper: as published; even: Gram matrix, mean and standard "
        "deviation count about equally, the first layer counts more, and pixel colors count too.",
    )
    style_loss: StyleLossName = Field(
        "sos",
        description="Comparison of views with the style; sos: feature statistics, as in the paper; nnfm: each feature "
        "with its nearest neighbor in the style, as in ARF; mixed: both.",
    )
    position_weights: PositionWeights = Field(
        "auto",
        description="Weight statistics by coverage, so that an empty background does not count; auto: if views have "
        "uncovered pixels.",
    )
    precision: Precision = Field(
        "auto",
        description="Precision of the feature network; winograd: float32 with fewer multiplications, on CPUs; tf32: "
        "for convolutions only; tf32 and float16: on NVIDIA GPUs; "
        "auto: the fastest that the processor computes by itself.",
    )
    max_resolution: Resolution = None
    background: Annotated[
        Color,
        Option(
            unit="RGB, 0 to 1",
            metavar="COLOR",
            default="black",
            parse=parse_color,
            syntax=COLOR_SYNTAX,
        ),
    ] = Field((0.0, 0.0, 0.0), description="Background color behind the Gaussians.")
    training_background: TrainingBackground = Field(
        "auto",
        description="Background during steps; background: the background color; random: a random color each time; "
        "palette: the color of a random style pixel; auto: depends on how much of the views is uncovered.",
    )
    near: Near = NEAR
    style_scale: Annotated[float, Option(unit="factor", metavar="S")] = Field(
        1.0,
        ge=0.25,
        le=4,
        description="Draw strokes S times as large as they are in the style image, fitted to a view.",
    )
    style_rotation: Annotated[float, Option(unit="degrees", metavar="D")] = Field(
        0.0, ge=-360, le=360, description="Rotate the style image counterclockwise by D degrees."
    )
    preserve_colors: PreservedColors = Field(
        "no",
        description="Preserve the scene's colors; match: recolor the style image like the scene first, so that only "
        "its strokes are transferred; luminance: change only the luminance of colors.",
    )
    sh_attenuation: Annotated[Fraction, Option(unit="fraction", metavar="S")] = Field(
        0.0,
        description="Attenuate view-dependent color by S, in the result too; 0 leaves spherical harmonics unchanged, "
        "1 removes all above degree 0.",
    )
    scales: Annotated[
        tuple[ScaleWeight, ...],
        Option(
            unit="scale weights",
            metavar="W,W,...",
            default="all equal",
            parse=parse_weights,
            syntax=". 1,0,0.5 uses the first and the third.",
        ),
        AfterValidator(_some_weight),
    ] = Field(
        (),
        max_length=16,
        description="Weight of each scale in the loss, starting at full size, each scale half as large as the one "
        "before; scales without a weight, or with weight 0, are not computed.",
    )
    scale_sampling: Annotated[int, Option(unit="visits", metavar="N")] = Field(
        1,
        ge=1,
        le=16,
        description="In phase 2, evaluate a scale other than the coarsest in one of N visits of a view that evaluate "
        "the next coarser scale, drawn at random, with N times the weight; 1 evaluates all scales in every step.",
    )
    refine: Annotated[RefineFactor | Literal["auto"], Option(unit="factor", metavar="N")] = Field(
        1.0,
        description="Split Gaussians that are large on screen, for finer strokes: up to N times as many in total "
        "(1 = off); auto: only those too large for the strokes of the finest scale, up to twice as many in total.",
    )
    seed: int = Field(0, ge=0, lt=2**63, description="Seed for the order of views and for random training backgrounds.")
    within: Annotated[
        float | None,
        Option(
            unit="seconds",
            metavar="TIME",
            default="no limit",
            parse=parse_seconds,
            syntax=", such as 90s, 5m or 1h.",
        ),
    ] = Field(
        None,
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="Time budget of the whole job, from its start to its last file; chooses the resolution, the number "
        "of views and the steps that fit, unless they are given.",
    )
    fixed: Annotated[tuple[str, ...], Option(instead="within")] = Field(
        (), description="What a time budget and the plan leave as it is: given settings, and `views`."
    )
    memory_limit: Annotated[
        int | None,
        Option(
            unit="bytes",
            metavar="SIZE",
            default="40 % of memory, at most",
            parse=parse_bytes,
            syntax=", such as 8GB.",
        ),
    ] = Field(None, gt=0, le=2**50, description="Memory budget of the plan.")
    unseen: Literal["neighbors", "freeze"] = Field(
        "neighbors",
        description="Colors of Gaussians that no view sees; neighbors: change like their neighbors' colors; freeze: "
        "stay unchanged.",
    )
    coarsest_side: Annotated[int, Option(unit="pixels", metavar="N")] = Field(
        COARSEST_SHORTER_SIDE,
        ge=16,
        le=MAX_RESOLUTION,
        description="Maximum shorter side of the coarsest scale in pixels; the paper's is 511.",
    )
    warm_start: Annotated[bool | None, Option(flags="--warm-start/--cold-start", default="on")] = Field(
        None,
        description="Start with colors that are distributed like the style's. With preserve_colors luminance, the "
        "default is on for scans only.",
    )
    clamp_aware_gradient: bool = Field(False, description="Apply gradients that would raise clamped (negative) colors.")
    bounded: bool = Field(
        False,
        description="Project colors to 0..1, the displayable range, after each step, and to the line or plane in RGB "
        "that contains the style's colors, if there is one (black and white, few hues).",
    )
    early_stop: bool = Field(
        False,
        description="Stop when the smoothed loss of all scales no longer falls. With within, the default is off.",
    )
    target_loss: Annotated[float | None, Option(unit="fraction of the initial loss", metavar="R", default="never")] = (
        Field(
            None,
            gt=0,
            lt=1,
            description="Stop when the loss has fallen to this fraction of the initial loss, such as 0.05.",
        )
    )
    cached_weights: CachedWeights = Field(
        "auto", description="Precision of blend weights that are cached between steps; auto: as memory allows."
    )
    views_per_step: Annotated[int, Option(unit="views", metavar="V")] = Field(
        1,
        ge=1,
        le=10_000,
        description="Average the gradients of V views in each step; groups of workers evaluate them in parallel. "
        "Unless this or the steps are given, each of several workers may get a view of its own, in fewer steps.",
    )
    measure: Annotated[Fraction, Option(unit="fraction of the steps' passes", metavar="S")] = Field(
        0.05,
        description="Measure novel views, which lie between the cameras, before and after the steps, as far as all "
        "measurements take at most S as many passes as the steps; 0 measures none.",
    )

    @property
    def growth(self) -> float:
        """Maximum factor by which refinement multiplies the number of Gaussians; 1 if it is off."""
        return _AUTO_GROWTH if self.refine == "auto" else self.refine

    def learning_rate_at(self, fraction: float) -> float:
        """Return Adam's learning rate after a fraction (0..1) of all steps."""
        return float(self.learning_rate * (self.learning_rate_end / self.learning_rate) ** fraction)

    def with_steps(self, coarse: int, sos: int) -> Self:
        """Return the settings with other numbers of steps, whose learning rate falls from step to step as before.

        An end of the learning rate that was given remains.
        """
        before, steps = self.steps_coarse + self.steps_sos, coarse + sos
        changed: dict[str, object] = {"steps_coarse": coarse, "steps_sos": sos}
        if "learning_rate_end" not in self.fixed and before > 1:
            changed["learning_rate_end"] = self.learning_rate_at(max(steps - 1, 0) / (before - 1))
        return self.model_copy(update=changed)


#: `paper` is the published schedule. The other presets reach a given loss sooner, with larger, decaying steps. Such
#: steps push many colors below 0, so these presets need `clamp_aware_gradient`. They start from the style's colors,
#: which optimization alone reaches only slowly (docs/quality.md). `standard` has no phase 1, because most of its steps
#: evaluate the coarsest scale alone.
_PRESETS: dict[PresetName, dict[str, Any]] = {
    "preview": {
        "steps_coarse": 50,
        "steps_sos": 60,
        "learning_rate": 0.2,
        "learning_rate_end": 0.05,
        "clamp_aware_gradient": True,
        "bounded": True,
        "max_resolution": 640,
    },
    "standard": {
        "steps_coarse": 0,
        "steps_sos": 240,
        "scale_sampling": 3,
        "learning_rate": 0.2,
        "learning_rate_end": 0.02,
        "clamp_aware_gradient": True,
        "bounded": True,
        "early_stop": True,
    },
    "paper": {
        "steps_coarse": 10_000,
        "steps_sos": 10_000,
        "learning_rate": 2.5e-3,
        "learning_rate_end": 2.5e-3,
        "precision": "float32",
        "feature_scale": "paper",
        "position_weights": "off",
        "training_background": "background",
        "warm_start": False,
        "unseen": "freeze",
    },
}


def make_settings(preset: PresetName = "standard", **values: Any) -> Settings:
    """Return the settings of a preset with the given values replaced; None keeps the preset's value.

    Settings have the names of the command line and the REST API.

    With fewer steps than the preset's, the learning rate falls only as far as the preset's falls in as many steps:
    falling to the preset's end, it would stop the colors before they are near the style's.

    Raises:
        SettingsError: If the preset is unknown, or a value is out of range.

    Example:
        >>> settings = make_settings("preview", steps_sos=10)
        >>> settings.steps_sos, settings.max_resolution
        (10, 640)
    """
    if preset not in _PRESETS:
        raise SettingsError(f"There is no preset {preset!r}. Choose one of {', '.join(_PRESETS)}.")
    shown = declared(Settings)
    chosen = {shown[name].field if name in shown else name: each for name, each in values.items() if each is not None}
    if "learning_rate" in chosen:  # an explicit learning rate is constant, unless its end is given too
        chosen.setdefault("learning_rate_end", chosen["learning_rate"])
    if "within" in chosen:  # the given time is used as long as steps are left
        chosen.setdefault("early_stop", False)
    chosen.setdefault("fixed", tuple(name for name in _CHOSEN if name in chosen))
    whole = _PRESETS[preset]
    settings = checked(Settings, {"preset": preset, **whole, **chosen})
    coarse, sos = settings.steps_coarse, settings.steps_sos
    if coarse + sos >= whole["steps_coarse"] + whole["steps_sos"] or "learning_rate_end" in chosen:
        return settings
    of_preset = {"steps_coarse": whole["steps_coarse"], "steps_sos": whole["steps_sos"]}
    return settings.model_copy(update=of_preset).with_steps(coarse, sos)


def checked(model: type[M], values: Mapping[str, object]) -> M:
    """Validate values against a model.

    Raises:
        SettingsError: If a name is unknown or a value is invalid; the message reports the first error.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = merged(error.errors())[0]
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise SettingsError(f"Setting {name} {unknown_text(name, declared(model))}") from error
        raise SettingsError(f"Setting {name} = {first['input']!r}: {reason(first)}.") from error


def preset_texts(setting: Declared) -> dict[str, str]:
    """Return the default of a setting as text for each preset."""
    return {preset: setting.text(getattr(make_settings(preset), setting.field)) for preset in _PRESETS}


def default_text(setting: Declared) -> str:
    """Return the default of a setting as text; if it depends on the preset, list it for each preset."""
    values = preset_texts(setting)
    if len(set(values.values())) == 1:
        return values["standard"]
    return f"{BY_PRESET}: " + ", ".join(f"{preset} {value}" for preset, value in values.items())
