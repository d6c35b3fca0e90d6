"""The optimiser loop: Adam on the DC colours, coarse phase then SOS, one view a step.

One step at a time; `loop.run` makes them all.
"""

from __future__ import annotations

import importlib.util
import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import psutil
import torch
from torch import Tensor

from sgsst_core.budget import MEMORY_SHARES, default_memory_limit
from sgsst_core.errors import CameraError, DivergedError, RanksDriftedError
from sgsst_core.features.network_weights import BackboneWeights, load_weights
from sgsst_core.loss.sos import SosLoss, SosResult, ViewTarget
from sgsst_core.loss.terms import LayerTarget, LossTerms
from sgsst_core.parallel.collectives import ALONE, Collectives, RankLeftOut, same_on_all
from sgsst_core.planning.planner import Plan, choose_network, make_plan
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.coarse import CoarseRasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizing.unseen import neighbours_change
from sgsst_core.stylizing.views import PhotoLoader, Views
from sgsst_core.stylizing.warm_start import warm_start
from sgsst_core.timing import Timer

#: Adam's epsilon: as good as none, so that Gaussians of any blend weight move at the learning rate (SGSST).
ADAM_EPS = 1e-15
#: Adam squares gradients in float32. Beyond this a square is infinite and its value would never move again, silently.
LARGEST_GRADIENT = 1e19

#: Steps between two proofs that all ranks have the same colours.
DRIFT_STEPS = 50
#: Steps of a phase after which the ranks' speeds are compared; the first one, which prepares more, does not count.
BALANCE_STEPS = 6
#: Ranks are given other shares of the work only where the fastest is faster than the slowest by more than this.
LEAST_IMBALANCE = 1.15

#: Views on which a job is evaluated before and after, and which the contact sheet shows.
EVALUATION_VIEWS = 4

Evaluation = dict[int, LossTerms]


@dataclass(frozen=True)
class Phase:
    """A part of the schedule.

    Attributes:
        stage: its name: "coarse" (phase 1) and "sos" (phase 2) in every preset.
        steps: how many.
        scale: the one scale that is optimised, counted from the coarsest (0); None for all, the SOS loss.
    """

    stage: str
    steps: int
    scale: int | None = None

    def scales(self, count: int) -> list[int]:
        """The scales of a view that has `count`, 0 being full size."""
        return list(range(count)) if self.scale is None else [max(count - 1 - self.scale, 0)]


@dataclass(frozen=True)
class StepRecord:
    """One iteration.

    Attributes:
        step: counted from 1 over both phases.
        stage: of the phase: "coarse", "sos".
        view: index of the camera; the first one where a step has several.
        seconds: wall-clock seconds of iterations so far, of all sessions of a resumed job.
        loss: E of the step's views before the step, their mean.
        terms: split loss by scale.
        parts: seconds of this step by what they went into.
        memory: bytes of physical memory that the process held after the step.
    """

    step: int
    stage: str
    view: int
    seconds: float
    loss: float
    terms: dict[int, LossTerms]
    parts: dict[str, float]
    memory: int


@dataclass
class StylizerState:
    """Everything that a resumed run needs to go on bit for bit."""

    sh_dc: Tensor  # [N, 3]
    first_moment: Tensor  # [N, 3]
    second_moment: Tensor  # [N, 3]
    step: int
    seconds: float
    generator: Tensor  # state of the random generator
    queue: list[int]  # views left in this round
    history: list[StepRecord] = field(default_factory=list)
    seconds_by_part: dict[str, float] = field(default_factory=dict)
    memory: int | None = None  # bytes planned with: partition and kept weights follow from it, and so does rounding
    measured: list[dict[str, Any]] = field(default_factory=list)  # see `Stylizer.measured`


class Stylizer:
    """One scene's stylization, step by step.

    Args:
        scene: what to stylize.
        cameras: the views; larger ones are brought down to `settings.max_resolution`. Those that see nothing are left
            out (see `views.covered`).
        style: [H, W, 3] in 0..1.
        settings: see `Settings`.
        weights: of the feature network; None loads VGG19, or VGG16 where only that is installed.
        photos: content image of a camera by its index, at its (brought down) size; None for unstylized renders.
        rasterizer: "auto", "cpu", "cached", "cuda" or "reference".
        schedule: phases in their order; None for those of the settings, as planned.
        collectives: of the ranks that stylize the scene together. Every rank has a stylizer with the same arguments and
            calls the same methods in the same order; `state`, `stylized` and the like, which only read, need no other.
        plan: of an earlier run of the same job; None makes one.

    Attributes:
        collectives: of all ranks that take part.
        group: of those that work on the same views as this one.

    Raises:
        CameraError: no cameras, or none sees a Gaussian.
        WeightsError: no weights.
        RankLeftOut: the job goes on without this rank.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        style: Tensor,
        settings: Settings,
        *,
        weights: BackboneWeights | None = None,
        photos: PhotoLoader | None = None,
        rasterizer: str = "auto",
        schedule: Sequence[Phase] | None = None,
        collectives: Collectives = ALONE,
        plan: Plan | None = None,
    ) -> None:
        if not cameras:
            raise CameraError("There are no cameras. Give a camera file, or let --orbit make some.")
        self.settings = settings
        self.timer = Timer()
        self.seconds = 0.0
        self.seconds_by_part: dict[str, float] = {}
        self.step = 0
        self.history: list[StepRecord] = []
        #: What was measured between steps (`loop.Callbacks.measure`): values for JSON, kept through a resume.
        self.measured: list[dict[str, Any]] = []
        self.weights = weights or load_weights("auto")
        self.photos = photos
        self.style = style
        self.network, precision = choose_network(self.weights, settings, collectives)
        limit = settings.memory_limit or default_memory_limit(self.network.device)
        #: The partition follows from it, and so does rounding: it must be the same on all ranks.
        self.memory_limit = min(collectives.all_gather(limit))
        sharing = self._sharing(collectives)
        self.memory = self.memory_limit // sharing
        cameras = fit_cameras(cameras, settings)
        if plan is None:
            whole = self._rasterizer(scene, "cpu" if rasterizer in ("auto", "cached") else rasterizer)
            plan = make_plan(scene, cameras, settings, self._loss(ALONE), whole, self.memory, collectives, sharing)
            plan.decisions.extend(precision)
        self.plan = plan
        self._join(collectives)
        self.loss = self._loss(self.group)
        self.scene = scene
        seen = scene if self.plan.seen.all() else scene.subset(self.plan.seen)
        seen = seen if "sh" in settings.keep else seen.without_zero_bands()
        self.views = Views(
            seen,
            cameras,
            self._rasterizer(seen, rasterizer),
            self.loss,
            covered=self.plan.covered,
            weighted=self.plan.weighted,
            photos=photos,
            memory=int(self.memory * MEMORY_SHARES["views"]),
            keep_content="content" not in settings.keep,
            revive=settings.revive,
            regions=self.plan.survey.regions if self.plan.weighted else None,
            collectives=self.group,
        )
        self._coarse = self._coarse_rasterizer(seen)
        self._style_targets: dict[tuple[int, int], dict[int, dict[str, LayerTarget]]] = {}
        start = seen.sh_dc
        if settings.warm_start:
            start = warm_start(start, self.plan.survey.total_weights[self.plan.seen], style)
        self.sh_dc = start.clone().to(self.views.rasterizer.device).requires_grad_()
        self._adam = torch.optim.Adam([self.sh_dc], lr=settings.learning_rate, eps=ADAM_EPS)
        self._generator = torch.Generator().manual_seed(settings.seed)
        self._queue: list[int] = []
        self.schedule = list(schedule or (Phase("coarse", self.plan.steps_coarse, 0), Phase("sos", settings.steps_sos)))
        self.total = sum(phase.steps for phase in self.schedule)
        self._process = psutil.Process()
        self._start: Evaluation | None = None

    def _sharing(self, collectives: Collectives) -> int:
        """Most ranks that have to share the memory of a machine; each GPU has its own."""
        return max(collectives.all_gather(1 if self.network.device.type == "cuda" else collectives.local_size))

    def _join(self, collectives: Collectives) -> None:
        """Take part in what the plan needs, in the group whose views are this rank's."""
        taking_part = collectives.first(min(self.plan.ranks, collectives.size))
        if taking_part is None:
            raise RankLeftOut
        self.collectives = taking_part
        self.memory = self.memory_limit // self._sharing(taking_part)
        self.groups = math.gcd(self.settings.views_per_step, taking_part.size)
        self.group = taking_part.split(self.groups)
        expected = self.plan.prediction
        for ranks in (self.collectives, self.group):
            ranks.expect(expected.seconds if expected else 0.0)
        #: Pixels and seconds of this rank's share of the network in each step, until ranks have been compared.
        self._pace: list[tuple[int, float]] | None = [] if self.settings.rebalance and self.group.size > 1 else None
        self._cost = 0

    def _loss(self, collectives: Collectives) -> SosLoss:
        settings = self.settings
        return SosLoss(
            self.network,
            content_weight=settings.content_weight,
            memory=int(self.memory * MEMORY_SHARES["activations"]),
            coarsest=settings.coarsest_side,
            leave_out="uncovered" not in settings.keep,
            keep_activations="activations" not in settings.keep,
            timer=self.timer,
            collectives=collectives,
        )

    def _rasterizer(self, scene: Scene, name: str) -> Rasterizer:
        """The rasterizer of a name; "auto" is gsplat on a GPU that has it, else what the plan says."""
        options: dict[str, Any] = {"background": self.settings.background, "near": self.settings.near}
        if name == "auto":
            gsplat = self.network.device.type == "cuda" and importlib.util.find_spec("gsplat") is not None
            name = "cuda" if gsplat else "cpu" if self.plan.kept_weights == "none" else "cached"
        if name == "cached":
            options |= {"device": self.network.device, "max_bytes": self._weights_budget(coarse=False)}
            options |= {"precision": "half" if self.plan.kept_weights == "half" else "float32"}
        return make_rasterizer(name, scene, **options)

    def _coarse_rasterizer(self, scene: Scene) -> CoarseRasterizer | None:
        """Keeps blend weights of the coarsest scale for phase 1, where the plan says so."""
        if not self.plan.coarse_weights or self.views.rasterizer.name != "cached" or self.network.device.type != "cpu":
            return None
        cpu = CpuRasterizer(scene, background=self.settings.background, near=self.settings.near)
        return CoarseRasterizer(cpu, self._weights_budget(coarse=True))

    def _weights_budget(self, *, coarse: bool) -> int:
        """Bytes for kept blend weights: of full views, or of their coarsest scale in phase 1."""
        budget = int(self.memory * MEMORY_SHARES["rasterizer"])
        share = budget // 4 if self.plan.coarse_weights else 0
        return share if coarse else budget - share

    @property
    def phase(self) -> Phase:
        """The phase that the next step belongs to; the last one when all steps are done."""
        done = self.step
        for phase in self.schedule:
            if done < phase.steps:
                return phase
            done -= phase.steps
        return self.schedule[-1]

    def share_done(self) -> float:
        """How much of the schedule is done, 0 to 1: what the learning rate follows."""
        return self.step / max(self.total - 1, 1)

    @property
    def round_length(self) -> int:
        """Steps in which every view comes once."""
        return math.ceil(len(self.views.covered) / self.settings.views_per_step)

    def scale_count(self, index: int) -> int:
        """n_s of a view."""
        camera = self.views.cameras[index]
        return self.loss.scale_count(camera.height, camera.width)

    @property
    def evaluation_views(self) -> list[int]:
        """Indices of at most four views, evenly spread over those that see anything."""
        covered = self.views.covered
        count = min(EVALUATION_VIEWS, len(covered))
        return [covered[(2 * part + 1) * len(covered) // (2 * count)] for part in range(count)]

    def start(self) -> Evaluation:
        """Loss of the unstylized scene on the evaluation views."""
        if self._start is None:
            self._start = self.evaluate(self.evaluation_views, self.views.scene.sh_dc)
        return self._start

    def style_targets(self, camera: Camera) -> dict[int, dict[str, LayerTarget]]:
        """The style's statistics for views of the camera's size."""
        size = (camera.height, camera.width)
        if size not in self._style_targets:
            self._style_targets[size] = self.loss.style_targets(self.style.to(self.network.device), size)
        return self._style_targets[size]

    def run_step(self) -> StepRecord:
        """One iteration.

        Raises:
            DivergedError: the gradient has left the range of float32; the colours are those before the step.
        """
        started = time.perf_counter()
        self.timer.seconds.clear()
        phase = self.phase
        if phase.scale is None:
            self._coarse = None  # phase 1 is over
        views = [self._next_view() for _ in range(self.settings.views_per_step)]
        gradient, terms = self._mean_gradient(views, phase)
        with self.timer("optimiser"):
            self._update(gradient)
        self.step += 1
        self._check_drift()
        self._balance(phase)
        self.seconds += time.perf_counter() - started
        for name, seconds in self.timer.seconds.items():
            self.seconds_by_part[name] = self.seconds_by_part.get(name, 0.0) + seconds
        record = StepRecord(
            self.step,
            phase.stage,
            views[0],
            self.seconds,
            mean_loss(terms),
            terms,
            dict(self.timer.seconds),
            self._process.memory_info().rss,
        )
        self.history.append(record)
        return record

    def _mean_gradient(self, views: list[int], phase: Phase) -> tuple[Tensor, Evaluation]:
        """dE/dsh_dc [n, 3] and loss, mean over some views: each group of ranks takes its own."""
        gradient: Tensor | None = None
        evaluations = []
        self._cost = 0
        for index in views[self.collectives.rank // self.group.size :: self.groups]:
            scales = phase.scales(self.scale_count(index))
            with self.timer("prepare"):
                target = self.views.target(index, scales)
                style = self.style_targets(self.views.cameras[index])
            assert target.share is not None
            self._cost += target.share.cost(self.group.rank, self.network.halo)
            own, result = self._gradient(index, style, target, scales)
            gradient = own if gradient is None else gradient.add_(own)
            evaluations.append(result.terms)
        assert gradient is not None
        if len(views) > 1:
            with self.timer("communication"):
                every = self.collectives.all_gather(evaluations)[:: self.group.size]
                evaluations = [terms for part in every for terms in part]
                if self.groups > 1:  # all ranks of a group have the same gradient: count it once
                    gradient = self.collectives.all_reduce(gradient / self.group.size)
            gradient = gradient / len(views)
        return gradient, mean_evaluation(evaluations)

    def _check_drift(self) -> None:
        """Prove now and then that all ranks have the same colours."""
        if self.collectives.size == 1 or self.step % DRIFT_STEPS:
            return
        with self.timer("communication"):
            checksum = zlib.crc32(self.sh_dc.detach().cpu().numpy().tobytes())
            if not same_on_all(self.collectives, checksum):
                raise RanksDriftedError(
                    f"Step {self.step}: the ranks' colours are no longer the same. They compute differently: run on "
                    "machines of one kind, with the same versions of this program and of PyTorch."
                )

    def _balance(self, phase: Phase) -> None:
        """Once in the phase on all scales, share the work out in proportion to the speeds that ranks have shown."""
        if self._pace is None or phase.scale is not None:
            return
        seconds = sum(self.timer.seconds.get(part, 0.0) for part in ("vgg_forward", "vgg_backward", "statistics"))
        self._pace.append((self._cost, seconds))
        if len(self._pace) < BALANCE_STEPS:
            return
        # Medians: one step in which the machine did something else says nothing.
        rates = sorted(cost / seconds for cost, seconds in self._pace[1:] if cost)
        self._pace = None
        speeds = self.group.all_gather(rates[len(rates) // 2] if rates else 0.0)
        known = [speed for speed in speeds if speed > 0]
        if max(known) > LEAST_IMBALANCE * min(known):
            self.loss.speeds = tuple(speed or sum(known) / len(known) for speed in speeds)
            self.views.share_anew()

    def _update(self, gradient: Tensor) -> None:
        largest = float(gradient.abs().max())
        if not largest <= LARGEST_GRADIENT:
            raise DivergedError(
                f"Step {self.step + 1}: the colour gradient has grown to {largest:.3g}, which cannot be optimised; the "
                f"largest colour coefficient is {float(self.sh_dc.detach().abs().max()):.3g}. Give a smaller "
                f"--learning-rate than {self.settings.learning_rate:g}, or look for extreme coefficients with `sgsst "
                "check`."
            )
        for group in self._adam.param_groups:
            group["lr"] = self.settings.learning_rate_at(self.share_done())
        self.sh_dc.grad = gradient.to(self.sh_dc.dtype)
        self._adam.step()

    def _next_view(self) -> int:
        """Random views without replacement: every view once before any comes again."""
        if not self._queue:
            covered = self.views.covered
            self._queue = [covered[i] for i in torch.randperm(len(covered), generator=self._generator).tolist()]
        return self._queue.pop()

    def evaluate(self, indices: Sequence[int], sh_dc: Tensor | None = None) -> Evaluation:
        """Mean SOS loss over views, split by scale; changes nothing, its time does not count.

        Args:
            sh_dc: [n, 3], colours to evaluate in place of the present ones of the n optimised Gaussians.
        """
        values = (self.sh_dc.detach() if sh_dc is None else sh_dc).to(self.sh_dc.device)
        return evaluate(self.views, self.style_targets, indices, values)

    def gradient(self, index: int, scales: Sequence[int]) -> tuple[Tensor, float]:
        """dE/dsh_dc [n, 3] of the n optimised Gaussians on the CPU, as a step computes it, and its seconds.

        Targets are prepared before the clock starts. Changes nothing.
        """
        target, style = self.views.target(index, scales), self.style_targets(self.views.cameras[index])
        started = time.perf_counter()
        gradient = self._gradient(index, style, target, scales)[0]
        return gradient.cpu(), time.perf_counter() - started

    def _gradient(
        self, index: int, style: dict[int, dict[str, LayerTarget]], target: ViewTarget, scales: Sequence[int]
    ) -> tuple[Tensor, SosResult]:
        """dE/dsh_dc [n, 3] of one view, and the loss."""
        if self._coarse is not None and len(scales) == 1 and scales[0] > 0:
            return self._coarse_gradient(self._coarse, index, style, target, scales[0])
        with self.timer("render"), torch.no_grad():
            colours = self.views.colours(index, self.sh_dc.detach())
            image = self.views.render(index, colours)
        with self.timer("loss"):
            result = self.loss.evaluate(image, style, target, scales)
        with self.timer("raster_backward"):
            assert result.image_gradient is not None
            return self.views.gradient(index, result.image_gradient.to(image.device), colours), result

    def _coarse_gradient(
        self,
        rasterizer: CoarseRasterizer,
        index: int,
        style: dict[int, dict[str, LayerTarget]],
        target: ViewTarget,
        scale: int,
    ) -> tuple[Tensor, SosResult]:
        """The same of one scale alone, rendered at that scale."""
        camera = self.views.cameras[index]
        with self.timer("render"), torch.no_grad():
            colours = self.views.colours(index, self.sh_dc.detach())
            image = rasterizer.render(colours, camera, scale)
        with self.timer("loss"):
            result = self.loss.evaluate_scale(image, style[scale], target, scale)
        with self.timer("raster_backward"):
            assert result.image_gradient is not None
            gradient = rasterizer.colour_gradient(result.image_gradient.to(image.device), camera, scale)
            return self.views.add_up(gradient, colours), result

    def stylized(self) -> Tensor:
        """sh_dc [N, 3] float32 of the whole scene, on the CPU: the optimised colours, and those of unseen Gaussians."""
        result = self.scene.sh_dc.clone()
        result[self.plan.seen] = self.sh_dc.detach().cpu()
        if self.settings.unseen == "neighbours":
            weights = torch.where(self.plan.optimised, self.plan.survey.total_weights, 0.0)
            result[weights <= 0] += neighbours_change(self.scene.means, result - self.scene.sh_dc, weights)
        return result

    def set_colours(self, sh_dc: Tensor) -> None:
        """Put the colours [N, 3] of the whole scene in place of the present ones, to evaluate them on these views."""
        with torch.no_grad():
            self.sh_dc.copy_(sh_dc[self.plan.seen])

    def state(self) -> StylizerState:
        """A copy of all that a resumed run needs."""
        adam = self._adam.state.get(self.sh_dc, {})
        empty = torch.zeros_like(self.sh_dc)
        return StylizerState(
            sh_dc=self.sh_dc.detach().cpu().clone(),
            first_moment=adam.get("exp_avg", empty).detach().cpu().clone(),
            second_moment=adam.get("exp_avg_sq", empty).detach().cpu().clone(),
            step=self.step,
            seconds=self.seconds,
            generator=self._generator.get_state().clone(),
            queue=list(self._queue),
            history=list(self.history),
            seconds_by_part=dict(self.seconds_by_part),
            memory=self.memory_limit,
            measured=list(self.measured),
        )

    def load_state(self, state: StylizerState) -> None:
        """Go on from a state of a stylizer with the same arguments, and state.memory as its memory limit."""
        with torch.no_grad():
            self.sh_dc.copy_(state.sh_dc)
        if state.step:
            self._adam.state[self.sh_dc] = {
                "step": torch.tensor(float(state.step)),
                "exp_avg": state.first_moment.to(self.sh_dc.device).clone(),
                "exp_avg_sq": state.second_moment.to(self.sh_dc.device).clone(),
            }
        self.step = state.step
        self.seconds = state.seconds
        self._generator.set_state(state.generator)
        self._queue = list(state.queue)
        self.history = list(state.history)
        self.seconds_by_part = dict(state.seconds_by_part)
        self.measured = list(state.measured)


def fit_cameras(cameras: Sequence[Camera], settings: Settings) -> list[Camera]:
    """The cameras, those with more pixels than `settings.max_resolution` on their longer side brought down to it."""
    limit = settings.max_resolution
    return [
        resized(camera, limit) if limit and max(camera.width, camera.height) > limit else camera for camera in cameras
    ]


def evaluate(
    views: Views,
    style_targets: Callable[[Camera], dict[int, dict[str, LayerTarget]]],
    indices: Sequence[int],
    sh_dc: Tensor,
) -> Evaluation:
    """Mean SOS loss of colours [n, 3] over views, split by scale."""
    evaluations = []
    for index in indices:
        camera = views.cameras[index]
        with torch.no_grad():
            image = views.render(index, views.colours(index, sh_dc))
        target = views.target(index, range(views.loss.scale_count(camera.height, camera.width)))
        evaluations.append(views.loss.evaluate(image, style_targets(camera), target, gradient=False).terms)
    return mean_evaluation(evaluations)


def mean_evaluation(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Mean over views, scale by scale."""
    total: Evaluation = {}
    for evaluation in evaluations:
        for scale, part in evaluation.items():
            total[scale] = total.get(scale, LossTerms()) + part
    return {scale: terms / len(evaluations) for scale, terms in total.items()}


def mean_loss(evaluation: Evaluation) -> float:
    """E_SOS: the mean of the scales' losses."""
    return sum(terms.total for terms in evaluation.values()) / len(evaluation)
