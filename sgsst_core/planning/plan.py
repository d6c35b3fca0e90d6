"""Plan of a job: what was decided before the first iteration, for users and for the stylizer that follows it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from torch import Tensor

from sgsst_core.decision import Decision
from sgsst_core.planning.survey import Survey
from sgsst_core.planning.time_budget import TimeChoice
from sgsst_core.refine.split import Refinement
from sgsst_core.settings import WHOLE_FLOAT32, CachedWeights, PlannedBackground, PlannedPrecision

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class Prediction:
    """Predicted values of a job; per-iteration values are means over views.

    Attributes:
        seconds: Seconds per SOS iteration.
        seconds_coarse: Seconds per iteration of phase 1.
        peak_bytes: Peak physical memory of a rank.
        communication: Seconds per SOS iteration that a rank spends waiting for data from others.
        seconds_one_rank: Seconds per SOS iteration on a single rank; None if there is only one.
        device_bytes: Peak GPU memory; None on a CPU.
        first_visit: Additional time in seconds of a view's first visit in phase 2.
        first_visit_coarse: Additional time in seconds of a view's first visit in phase 1.
        style: Time in seconds for the style's statistics in the first step, assuming a style as large as a view.
        evaluation: Time in seconds for the loss on the evaluation views once they have been visited.
        losses: Time in seconds for the initial loss, including first visits of views that no step has visited.
        measuring: Time in seconds for all measurements outside the steps.
        job: Time in seconds for all steps, with first visits, style and measurements.
        ending: Seconds from the last step to the last file, except for measurements.
    """

    seconds: float
    seconds_coarse: float
    peak_bytes: int
    communication: float = 0.0
    seconds_one_rank: float | None = None
    device_bytes: int | None = None
    first_visit: float = 0.0
    first_visit_coarse: float = 0.0
    style: float = 0.0
    evaluation: float = 0.0
    losses: float = 0.0
    measuring: float = 0.0
    job: float = 0.0
    ending: float = 0.0


#: Number of ranks, and of the groups that they form.
Shape = tuple[int, int]


@dataclass(frozen=True)
class Plan:
    """Final decisions for a job.

    Attributes:
        optimized: [N] bool, Gaussians whose colors are determined by the views.
        seen: [N] bool, Gaussians that are rendered: those with a blend weight in a view.
        covered: Indices of the views that are stylized.
        weighted: Whether statistics are weighted by coverage.
        training_background: Background of the Gaussians in a step.
        warm_start: Whether the job starts with the style's colors.
        steps_coarse: Steps of phase 1; 0 if it is skipped.
        memory_limit: Memory budget in bytes of all ranks on one machine together.
        spare: Bytes of the budget for activations that no step needs, and that data of the views may use.
        spare_intersections: Bytes of `spare` that tile intersections may use, because data of the views do not.
        rasterizer: Rasterizer of the job; "cached" stores blend weights in the format `cached_weights`.
        uncached: Rasterizer that computes blend weights, and recomputes those that are not cached.
        graphs: Whether the loss of a view is captured as a CUDA graph where possible (`LossGraphs`).
        cached_weights: Format of blend weights that are cached between iterations.
        measured: Whether the prediction includes measurements between steps and the report.
        measuring: Level of measurements between steps, as an index into `measuring.LEVELS`; a later level is used if
            measuring is slower than predicted.
        loss_views: Number of views on which the loss is evaluated before and after.
        ranks: Number of ranks that take part.
        groups: Number of groups of ranks that the plan has formed, each of which evaluates a view of its own in every
            step (`choices.with_groups`); 1 if the settings decide.
        refinement: Refinement that produced the scene of the plan from the input scene; None if the input scene is not
            refined.
        time_choice: Choice of the time budget; None without one, or if everything was given.
        prediction: Predicted values, for comparison with the measured ones.
    """

    survey: Survey
    optimized: Tensor
    seen: Tensor
    covered: tuple[int, ...]
    weighted: bool
    steps_coarse: int
    memory_limit: int
    training_background: PlannedBackground = "background"
    warm_start: bool = False
    spare: int = 0
    spare_intersections: int = 0
    device: Device = "cpu"
    rasterizer: str = "cpu"
    uncached: str = "cpu"
    precision: PlannedPrecision = "float32"
    graphs: bool = False
    cached_weights: CachedWeights = "none"
    measured: bool = False
    measuring: int = 0
    loss_views: int = 4
    ranks: int = 1
    groups: int = 1
    refinement: Refinement | None = None
    time_choice: TimeChoice | None = None
    decisions: tuple[Decision, ...] = ()
    prediction: Prediction | None = None

    @property
    def is_approximated(self) -> bool:
        """Whether measurements compare the gradient of a step with the float32 reference."""
        return self.precision not in WHOLE_FLOAT32 or self.cached_weights == "half"

    def as_dict(self) -> dict[str, Any]:
        """Return decisions and prediction as JSON-serializable values."""
        return {
            "decisions": [asdict(decision) for decision in self.decisions],
            "prediction": asdict(self.prediction) if self.prediction else None,
        }
