"""What a job may be told beside its files: the options of `sgsst stylize`, as JSON."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from sgsst_core.constants import NEAR
from sgsst_core.settings import EVERYTHING, KeptWeights, PositionWeights, Precision, PresetName, Settings, make_settings

#: As of the command line.
MAX_RESOLUTION = 16384

#: Parameters that are no settings of the method, but of what is read or of the job.
_NOT_SETTINGS = {"name", "orbit", "up", "views", "resolution", "drop_invalid", "backbone", "workers", "keep_everything"}

#: A name is shown in terminals, and kept by databases that know no zero bytes.
_NO_CONTROLS = r"^[^\x00-\x1f\x7f-\x9f]*$"
_Share = Annotated[float, Field(ge=0, le=1)]


class JobParameters(BaseModel):
    """Parameters of a job; what is left out is the preset's, as for `sgsst stylize`."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"preset": "preview", "resolution": 480}, {"orbit": 24, "steps_sos": 100}]},
    )

    name: str = Field("", max_length=200, pattern=_NO_CONTROLS, description="For people; not unique.")
    preset: PresetName = Field("standard", description="Where the settings below start from.")
    orbit: int | None = Field(None, ge=1, le=2000, description="Instead of camera files: views around the scene.")
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = Field("-y", description="Axis that points up, for `orbit`.")
    views: int | None = Field(None, ge=1, le=1_000_000, description="Take so many of the cameras, spread evenly.")
    resolution: int | None = Field(None, ge=1, le=MAX_RESOLUTION, description="Pixels of every view's longer side.")
    steps_coarse: int | None = Field(None, ge=0, le=10_000_000, description="Steps on the coarsest scale.")
    steps_sos: int | None = Field(None, ge=0, le=10_000_000, description="Steps on all scales.")
    learning_rate: float | None = Field(None, gt=0, le=100, description="Adam's, then constant.")
    content_weight: float | None = Field(None, ge=0, le=1e12, description="Weight of the content term.")
    position_weights: PositionWeights | None = Field(None, description="Weigh positions by coverage.")
    background: tuple[_Share, _Share, _Share] | None = Field(None, description="RGB in 0..1 behind the Gaussians.")
    near: float = Field(NEAR, gt=0, allow_inf_nan=False, description="Near plane, in the scene's units.")
    drop_invalid: bool = Field(False, description="Leave Gaussians with NaN or infinite values out.")
    seed: int = Field(0, ge=0, lt=2**63, description="Of the order of views.")
    precision: Precision = Field("float32", description="Of the feature network.")
    backbone: Literal["auto", "vgg19", "vgg16"] = Field("auto", description="Feature network.")
    memory_limit: int | None = Field(None, gt=0, le=2**50, description="Bytes to plan with.")
    max_seconds: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="Stop after so long and take what is there."
    )
    target_loss: float | None = Field(None, gt=0, lt=1, description="Stop at this share of the loss at the start.")
    early_stop: bool | None = Field(None, description="Stop when the loss has stopped falling.")
    warm_start: bool | None = Field(None, description="Begin with the style's mean colour and spread.")
    revive: bool | None = Field(None, description="Let colours that fell below black come back.")
    coarsest_side: int | None = Field(None, ge=16, le=MAX_RESOLUTION, description="Shorter side of the coarsest scale.")
    prune_weight: float | None = Field(
        None, ge=0, allow_inf_nan=False, description="Leave out Gaussians that show in fewer pixels."
    )
    similar_views: float | None = Field(None, ge=0, lt=1, description="Leave out views that another one shows.")
    kept_weights: KeptWeights | None = Field(None, description="How blend weights are kept between steps.")
    unseen: Literal["neighbours", "keep"] | None = Field(None, description="Colours of Gaussians that no view sees.")
    keep_everything: bool = Field(False, description="Leave nothing out; slower, with the same result.")
    workers: int | None = Field(None, ge=1, le=1024, description="Ranks to spread the job over. [the service decides]")

    def settings(self) -> Settings:
        """The method's settings.

        Raises:
            SettingsError: a value out of range, or values that contradict each other.
        """
        values = self.model_dump(exclude={"preset", *_NOT_SETTINGS})
        keep = EVERYTHING if self.keep_everything else None
        return make_settings(self.preset, **values, max_resolution=self.resolution, keep=keep)
