"""Settings of a stylization and the presets that give them values."""

from __future__ import annotations

from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sgsst_core.constants import COARSEST_SHORTER_SIDE, NEAR
from sgsst_core.errors import SettingsError

PresetName = Literal["preview", "standard", "paper"]
Precision = Literal["float32", "bfloat16"]
PositionWeights = Literal["auto", "on", "off"]
KeptWeights = Literal["auto", "float32", "half", "none"]
#: What can be left out without changing the result, for `Settings.keep`.
Item = Literal["unseen", "sh", "uncovered", "activations", "content", "blend-weights", "ranks"]
EVERYTHING: tuple[Item, ...] = get_args(Item)


class Settings(BaseModel):
    """Everything that decides a result, apart from scene, cameras, style and photos.

    Attributes:
        preset: the preset that the values started from.
        steps_coarse: iterations of phase 1, on the coarsest scale alone.
        steps_sos: iterations of phase 2, on all scales.
        learning_rate: Adam's, at the start.
        learning_rate_end: Adam's at the end, reached exponentially; equal to learning_rate for a constant one.
        content_weight: lambda_c; 0 leaves the content branch out.
        position_weights: weigh statistics by rendered coverage: always, never, or where views have uncovered pixels.
        precision: of the feature network.
        max_resolution: longer side to which larger views are brought down; None for the cameras' own.
        background: RGB in 0..1 behind the Gaussians.
        near: near plane, world units.
        seed: of the order of views.
        max_seconds: wall-clock budget of the iterations; None for none.
        memory_limit: bytes to plan with; None for most of what is free.
        unseen: colours of Gaussians that no view sees: their neighbours' change, or kept as they are.
        coarsest_side: pixels of the coarsest scale's shorter side at most; the method's is 511.
        warm_start: begin with colours whose mean and covariance are the style's.
        revive: colours that the clamp holds at 0 take gradients that would raise them, instead of staying black.
        early_stop: end when the smoothed loss of all scales has stopped falling (`convergence`).
        target_loss: end when the smoothed loss of all scales, relative to the start, is at most this; None for never.
        prune_weight: Gaussians whose blend weights, summed over all pixels of all views, are at most this are treated
            as unseen; 0 takes out none that any pixel shows.
        similar_views: leave out views whose picture differs from that of a kept view by a shift of less than this share
            of the longer side; 0 leaves out none.
        kept_weights: how blend weights are kept between iterations; "auto" lets the memory decide.
        views_per_step: views of each step, whose gradients are averaged; ranks that form groups take them side by side.
        rebalance: share the work out anew, once, when ranks turn out to differ in speed. Without it a run on the same
            number of ranks can be repeated bit for bit even then.
        keep: items that are not left out although the scene does not need them; for comparison, the result is the same.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: PresetName = "standard"
    steps_coarse: int = Field(ge=0, le=10_000_000)
    steps_sos: int = Field(ge=0, le=10_000_000)
    learning_rate: float = Field(gt=0, le=100, allow_inf_nan=False)
    learning_rate_end: float = Field(gt=0, le=100, allow_inf_nan=False)
    content_weight: float = Field(1.0, ge=0, le=1e12, allow_inf_nan=False)
    position_weights: PositionWeights = "auto"
    precision: Precision = "float32"
    max_resolution: int | None = Field(None, ge=1)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near: float = Field(NEAR, gt=0, allow_inf_nan=False)
    seed: int = Field(0, ge=0, lt=2**63)
    max_seconds: float | None = Field(None, gt=0)
    memory_limit: int | None = Field(None, gt=0)
    unseen: Literal["neighbours", "keep"] = "neighbours"
    coarsest_side: int = Field(COARSEST_SHORTER_SIDE, ge=16)
    warm_start: bool = False
    revive: bool = False
    early_stop: bool = False
    target_loss: float | None = Field(None, gt=0, lt=1)
    prune_weight: float = Field(0.0, ge=0, allow_inf_nan=False)
    similar_views: float = Field(0.0, ge=0, lt=1)
    kept_weights: KeptWeights = "auto"
    views_per_step: int = Field(1, ge=1, le=10_000)
    rebalance: bool = True
    keep: tuple[Item, ...] = ()

    def learning_rate_at(self, share: float) -> float:
        """Adam's learning rate when `share` (0..1) of all steps is done."""
        return float(self.learning_rate * (self.learning_rate_end / self.learning_rate) ** share)


#: `paper` is the published schedule. The others reach its loss sooner with larger, decaying steps, which throw many
#: colours below 0 on their way and therefore need `revive` (docs/performance.md, "The standard preset").
_PRESETS: dict[PresetName, dict[str, Any]] = {
    "preview": {
        "steps_coarse": 50,
        "steps_sos": 60,
        "learning_rate": 0.2,
        "learning_rate_end": 0.05,
        "revive": True,
        "max_resolution": 640,
    },
    "standard": {
        "steps_coarse": 100,
        "steps_sos": 200,
        "learning_rate": 0.2,
        "learning_rate_end": 0.02,
        "revive": True,
        "early_stop": True,
    },
    "paper": {
        "steps_coarse": 10_000,
        "steps_sos": 10_000,
        "learning_rate": 2.5e-3,
        "learning_rate_end": 2.5e-3,
        "position_weights": "off",
        "unseen": "keep",
    },
}


def make_settings(preset: PresetName = "standard", **values: Any) -> Settings:
    """A preset's settings with single values on top; values that are None are left to the preset.

    Raises:
        SettingsError: unknown preset, or a value out of range.
    """
    if preset not in _PRESETS:
        raise SettingsError(f"There is no preset {preset!r}; choose one of {', '.join(_PRESETS)}.")
    chosen = {name: value for name, value in values.items() if value is not None}
    if "learning_rate" in chosen:  # a rate given by hand is meant as it is, unless its end is given too
        chosen.setdefault("learning_rate_end", chosen["learning_rate"])
    try:
        return Settings(**{"preset": preset, **_PRESETS[preset], **chosen})
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise SettingsError(f"Setting {name} = {first['input']!r}: {first['msg']}.") from error
