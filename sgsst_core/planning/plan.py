"""Plan of a job: what was decided before the first iteration, for users and for the stylizer that follows it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sgsst_core.decision import Decision
from sgsst_core.planning.facts import Device
from sgsst_core.planning.survey import Survey
from sgsst_core.planning.time_budget import TimeChoice
from sgsst_core.refine.split import Refinement
from sgsst_core.settings import WHOLE_FLOAT32, CachedWeights, PlannedBackground, PlannedPrecision


@dataclass(frozen=True)
class Work:
    """Pixels that a rank passes through the network in a mean step.

    Attributes:
        sos: Pixels in a step of phase 2.
        coarse: Pixels in a step of phase 1.
        measuring: Pixels outside of the steps, in passes for the initial loss and for novel views.
    """

    sos: float
    coarse: float
    measuring: float = 0.0


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
        spare: Bytes of the budget for activations that no step needs: half of them for data of the views, and half for
            tile intersections.
        peak_bytes: Upper bound of a rank's memory in bytes: the sum of the budgets that the job can use.
        device_bytes: The same of the GPU's memory; None on a CPU.
        rasterizer: Rasterizer of the job; "cached" stores blend weights in the format `cached_weights`.
        uncached: Rasterizer that computes blend weights, and recomputes those that are not cached.
        graphs: Whether the loss of a view is captured as a CUDA graph where possible (`LossGraphs`).
        cached_weights: Format of blend weights that are cached between iterations.
        measured: Whether quality is measured and a report is written.
        loss_views: Number of views on which the loss is evaluated before the steps.
        novel_views: Number of novel views that are measured before and after the steps.
        ranks: Number of ranks that take part.
        groups: Number of groups of ranks that the plan has formed, each of which evaluates a view of its own in every
            step (`choices.with_groups`); 1 if the settings decide.
        work: Work of the steps and of the measurements.
        refinement: Refinement that produced the scene of the plan from the input scene; None if the input scene is not
            refined.
        time_choice: Choice of the time budget; None without one, or if everything was given.
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
    peak_bytes: int = 0
    device_bytes: int | None = None
    device: Device = "cpu"
    rasterizer: str = "cpu"
    uncached: str = "cpu"
    precision: PlannedPrecision = "float32"
    graphs: bool = False
    cached_weights: CachedWeights = "none"
    measured: bool = False
    loss_views: int = 4
    novel_views: int = 0
    ranks: int = 1
    groups: int = 1
    work: Work = Work(0.0, 0.0)
    refinement: Refinement | None = None
    time_choice: TimeChoice | None = None
    decisions: tuple[Decision, ...] = ()

    @property
    def is_approximated(self) -> bool:
        """Whether measurements compare the gradient of a step with the float32 reference."""
        return self.precision not in WHOLE_FLOAT32 or self.cached_weights == "half"
