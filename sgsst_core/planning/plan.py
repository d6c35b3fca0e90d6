"""What was decided for a scene before the first iteration, for people and for the stylizer that follows it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from torch import Tensor

from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import RasterizerName
from sgsst_core.scene.split import Refinement
from sgsst_core.settings import CachedWeights, PlannedBackground, Precision

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class Decision:
    """One line of a plan.

    Attributes:
        item: what was looked at.
        decision: what was decided.
        reason: the evidence.
        seconds: saved in every iteration, estimated; None where that is not known.
        bytes: of memory saved; None likewise.
        error: what it may cost in accuracy; "none" for what changes no result beyond rounding.
    """

    item: str
    decision: str
    reason: str
    seconds: float | None = None
    bytes: int | None = None
    error: str = "none"


@dataclass(frozen=True)
class Prediction:
    """What the plan expects, mean over views.

    Attributes:
        seconds: of an SOS iteration.
        seconds_coarse: of an iteration of phase 1.
        peak_bytes: of physical memory of a rank, at any time.
        communication: seconds of an SOS iteration in which a rank waits for what others send.
        seconds_one_rank: of an SOS iteration on one rank; None where there is only one.
        device_bytes: of a GPU's memory, at any time; None where a CPU computes.
        first_visit: seconds that a view's first visit in phase 2 takes beside those of an iteration.
        first_visit_coarse: the same in phase 1.
        style: seconds that the style's statistics take in the first step; the style is taken to be as large as a view.
        evaluation: seconds of the loss on the evaluation views, once they have been visited.
        losses: seconds of the loss before and after, with first visits of views that no step has visited.
        measuring: seconds of all that is measured beside the steps.
        job: seconds of all steps, with first visits and the style, and of measuring.
        ending: seconds from the last step to the last file, beside measuring.
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


@dataclass(frozen=True)
class Plan:
    """What was decided for a scene. Nothing changes it afterwards.

    Attributes:
        survey: what the views show.
        optimized: [N] bool, Gaussians whose colors the views decide.
        seen: [N] bool, Gaussians that are rendered: the optimized ones, or all for comparison.
        covered: indices of the views that are stylized.
        weighted: statistics are weighted by coverage.
        training_background: what is behind the Gaussians in a step.
        warm_start: the job begins with the style's colors.
        steps_coarse: of phase 1; 0 where it is left out.
        memory_limit: bytes to plan with, of the ranks that share a machine's memory together.
        device: on which the feature network computes.
        rasterizer: that renders; "cached" keeps blend weights in the form `cached_weights`.
        uncached: rasterizer that computes blend weights, and every time those that are not kept.
        precision: of the feature network.
        search: cuDNN tries its algorithms before it chooses (`FeatureNetwork.search`).
        graphs: a view's loss is captured as a graph where it can be (`LossGraphs`).
        cached_weights: in which form blend weights are kept between iterations.
        coarse_weights: phase 1 keeps the weights of the coarsest scale only.
        measured: the prediction counts what measuring between steps and the report take.
        measuring: what is measured between steps, at most: place in `measuring.LEVELS`.
        loss_views: on how many views the loss is taken before and after.
        ranks: how many take part.
        refinement: of the scene that was read, into that of which the plan tells; None where it is the same.
        decisions: for people.
        prediction: for comparison with what happens.
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
    device: Device = "cpu"
    rasterizer: str = "cpu"
    uncached: RasterizerName = "cpu"
    precision: Precision = "float32"
    search: bool = False
    graphs: bool = False
    cached_weights: CachedWeights = "none"
    coarse_weights: bool = False
    measured: bool = False
    measuring: int = 0
    loss_views: int = 4
    ranks: int = 1
    refinement: Refinement | None = None
    decisions: tuple[Decision, ...] = ()
    prediction: Prediction | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "decisions": [asdict(decision) for decision in self.decisions],
            "prediction": asdict(self.prediction) if self.prediction else None,
        }
