"""Quality measurements between the steps of a job: novel views, and the error of the job's approximations."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from functools import cached_property, partial
from statistics import median
from typing import Any

from torch import Tensor

from sgsst_core.budget import measuring_memory
from sgsst_core.loss.statistics_terms import has_statistics
from sgsst_core.planning.measurement_choice import (
    LEVELS,
    NOTHING,
    Level,
    Prices,
    choose_level,
    novel_view_seconds,
)
from sgsst_core.quality.float32_reference import ExactLoss, Float32Reference, approximations, rasterizer_beside
from sgsst_core.quality.judge import Judge
from sgsst_core.quality.lpips import LPIPS_NETWORK, Lpips, load_lpips_or_none
from sgsst_core.quality.novel_views import NovelViews
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import WHOLE_FLOAT32
from sgsst_core.stylizing.evaluation import Evaluation, ShowViews, show_nothing
from sgsst_core.stylizing.job import StylizationJob
from sgsst_core.stylizing.stylizer import Stylizer


class Measurements:
    """Quality measurements of a job; pass an instance as `loop.Callbacks.measure`.

    The job is measured after certain steps, called moments. Each moment appends a JSON-serializable entry to
    `Stylizer.measured`, with the fields "step", "novel_views" and "approximation" (None if there is nothing to
    measure), and "seconds". The unstylized scene (step 0) is measured together with the first moment, so that it does
    not delay the first step. Networks and views are created at first use.

    The plan chooses a level, which determines how much is measured. If the first view takes longer than predicted, the
    first rank switches to a cheaper level once. The first entry records the level ("level") and the estimated seconds
    of later moments ("again"). If AlexNet is installed, the last entry holds the `Judgment` of the result as "judged",
    with the fields "before" and "after".

    Args:
        show: Callback before each view of a measurement, with the number of completed and of all views.
    """

    def __init__(self, stylizer: Stylizer, show: ShowViews = show_nothing) -> None:
        self._stylizer, self._show = stylizer, show
        self.approximated = approximations(stylizer)
        self._novel_views: NovelViews | None = None

    @cached_property
    def exact(self) -> Float32Reference:
        """Exact loss and gradient of the job."""
        return Float32Reference(self._stylizer, measuring_memory(self._stylizer.job.memory))

    @cached_property
    def _seen_by(self) -> tuple[Scene, Rasterizer]:
        """Scene of the novel views, and its rasterizer."""
        scene = self._stylizer.job.scene.without_zero_bands()
        return scene, rasterizer_beside(self._stylizer, scene)

    @property
    def level(self) -> Level:
        """Level, which determines how much is measured."""
        measured = self._stylizer.measured
        # Checkpoints without a level measured everything.
        return LEVELS[measured[0].get("level", 0) if measured else self._stylizer.job.plan.measuring]

    @property
    def moments(self) -> list[int]:
        """Steps after which the job is measured; empty if measuring is off."""
        stylizer = self._stylizer
        return self.level.moments(stylizer.job.total_steps) if stylizer.job.settings.measure else []

    def due(self, step: int) -> bool:
        """Return whether to measure the job after the given step."""
        return step > 0 and step in self.moments

    def seconds_left(self, step: int, *, ends: bool = False) -> float:
        """Predict the seconds of all measurements from a step on, including the initial loss.

        Args:
            step: Number of completed steps.
            ends: Whether the job ends at this step, so that only `at_the_end` remains.
        """
        expected, measured = self._stylizer.job.plan.prediction, self._stylizer.measured
        done, moments = {entry["step"] for entry in measured}, self.moments
        if ends and moments:
            moments = [0, step] if self.level.start else [step]
        left = sum((moment >= step or not measured) and moment not in done for moment in moments)
        price: float
        losses = expected.losses if expected else 0.0
        known: list[float] = [entry["seconds"] for entry in measured[1:] if "seconds" in entry]
        if known:
            price = median(known)
        elif measured and "again" in measured[0]:
            price = measured[0]["again"]
        else:
            price = (expected.measuring - losses) / max(len(self.moments), 1) if expected else 0.0
        return left * max(price, 0.0) + losses

    def evaluate(self, *, unstylized: bool = False) -> Evaluation:
        """Return the exact loss on the evaluation views, for the current colors or the unstylized scene."""
        stylizer = self._stylizer
        if unstylized and not self.approximated:
            return stylizer.start(self._show)
        with stylizer.measuring():
            if not self.approximated:
                return stylizer.evaluate(stylizer.job.evaluation_views, stylizer.shown(), self._show)
            colors = stylizer.job.scene.sh_dc if unstylized else stylizer.stylized()
            return self.exact.evaluate(stylizer.job.evaluation_views, colors, self._show)

    def at_the_end(self) -> None:
        """Measure the step at which the job stopped, if it has not been measured yet, and judge the result."""
        if self.moments:
            with self._stylizer.measuring():
                self._measure_start()
                measured = self._stylizer.measured
                if not measured or measured[-1]["step"] != self._stylizer.step:
                    self._measure(start=False)
                self._judge()

    def __call__(self, stylizer: Stylizer) -> None:
        """Measure the current colors if due, and the unstylized scene if it is required and not measured yet."""
        if stylizer.step == stylizer.job.total_steps:
            stylizer.stylized()  # the result is needed anyway, so its time does not count as measuring
        with stylizer.measuring():
            self._measure_start()
            if self.due(stylizer.step):  # not cached: timing the first view can change the level
                self._measure(start=False)

    def _judge(self) -> None:
        """Judge the result and the unstylized scene on the first rank.

        The judgment is added to the last entry as "judged".
        """
        stylizer, novel_views = self._stylizer, self._novel_views_of_job()
        if novel_views.lpips is None or stylizer.job.collectives.rank:
            return
        judge = make_judge(stylizer, novel_views, novel_views.lpips)
        colors = {"before": stylizer.job.scene.sh_dc, "after": stylizer.stylized()}
        judgments = {name: judge.judge(sh_dc) for name, sh_dc in colors.items()}
        stylizer.measured[-1]["judged"] = {name: asdict(one) for name, one in judgments.items() if one} or None

    def _measure_start(self) -> None:
        if self.level.start and not self._stylizer.measured:
            self._measure(start=True)

    def _measure(self, *, start: bool) -> None:
        """Measure the current colors or the unstylized scene, and append an entry."""
        stylizer, started = self._stylizer, time.perf_counter()
        approximation = asdict(self.exact.gradient_error(start=start)) if self.approximated else None
        own: dict[str, Any] = {}
        if not stylizer.measured:
            stylized = stylizer.stylized()  # timed as part of this moment; later calls return the cached colors
            seconds = time.perf_counter() - started
            own = self._first(stylizer.job.scene.sh_dc if start else stylized, seconds)
        moment = self._moment(stylizer.job.scene.sh_dc if start else stylizer.stylized(), own, start=start)
        step = 0 if start else stylizer.step
        entry = {"step": step, "novel_views": moment, "approximation": approximation, **own}
        entry["seconds"] = time.perf_counter() - started
        stylizer.measured.append(entry)

    def _moment(self, colors: Tensor, own: dict[str, Any], *, start: bool) -> dict[str, Any] | None:
        """Measure the novel views with colors [N, 3]; return None if there are no views.

        Args:
            own: Additional fields of the first entry, extended in place; empty for later entries.
            start: Whether the colors are those of the unstylized scene.
        """
        stylizer, novel_views = self._stylizer, self._novel_views_of_job()
        if own:
            own["novel_view_names"] = [novel_views.cameras[index].name for index in novel_views.views]
            own["lpips"] = LPIPS_NETWORK if novel_views.lpips else None
            own["approximated"] = self.approximated
        if not novel_views.views:
            return None
        measured = novel_views.measure(colors.to(novel_views.rasterizer.device), self._show)
        if not start and (not stylizer.measured or stylizer.measured[0]["step"]):
            measured = replace(measured, gram_relative=None)  # relative values require a measured start
        return measured.as_dict(0, 0.0) if start else measured.as_dict(stylizer.step, stylizer.seconds)

    def _first(self, colors: Tensor, seconds: float) -> dict[str, Any]:
        """Choose the level by timing one view with colors [N, 3]; return "level" and "again" of the first entry.

        `seconds` is the time of a moment apart from its views.
        """
        stylizer, index = self._stylizer, self._stylizer.job.plan.measuring
        again = 0.0
        if LEVELS[index].views and LEVELS[index].start:
            novel_views, prices = self._trial(colors, seconds)
            if novel_views.views:
                index = stylizer.job.collectives.broadcast(lambda: self._affordable(index, prices))
                again = prices.again(LEVELS[index])
            if LEVELS[index].views == 1:
                self._novel_views = novel_views
        if self._novel_views is None:
            self._novel_views = self._make(LEVELS[index].views)
        return {"level": index, "again": again}

    def _trial(self, colors: Tensor, seconds: float) -> tuple[NovelViews, Prices]:
        """Measure one novel view with colors [N, 3]; return it with the measured times.

        `seconds` is the time of a moment apart from its views.
        """
        # Loaded before the clock starts, because it is not a cost per view.
        lpips = load_lpips_or_none(self._stylizer.job.network.device)
        clock = [time.perf_counter()]
        novel_views = self._make(1, lpips)
        for _ in range(2 if novel_views.views else 0):  # the first pass includes intersections, depth and warps
            clock.append(time.perf_counter())
            novel_views.measure(colors.to(novel_views.rasterizer.device))
        clock.append(time.perf_counter())
        again = clock[-1] - clock[-2]
        return novel_views, Prices(max(clock[-2] - clock[0] - again, 0.0), again, seconds)

    def _affordable(self, index: int, prices: Prices) -> int:
        """Return the index of the first affordable level at or after `index`, given the measured times.

        The times include no compilation, because some steps have already run.
        """
        stylizer, expected = self._stylizer, self._stylizer.job.plan.prediction
        if expected is None:
            return index
        allowed = novel_view_seconds(stylizer.job.settings, expected)
        # One view is already prepared, so measuring it at the end is always affordable.
        return min(choose_level(prices, allowed, stylizer.job.total_steps, index), NOTHING - 1)

    def _novel_views_of_job(self) -> NovelViews:
        if self._novel_views is None:
            self._novel_views = self._make(self.level.views)
        return self._novel_views

    def _make(self, views: int, lpips: Lpips | None = None) -> NovelViews:
        """Create the novel views of the job, at most `views` of them."""
        stylizer, (scene, rasterizer) = self._stylizer, self._seen_by
        # Features that define Gram distances are float32, and have Gram statistics even if the job optimizes another
        # loss.
        source: StylizationJob | ExactLoss = stylizer.job
        if not has_statistics(stylizer.job.settings.style_loss):
            source = ExactLoss(stylizer, "sos")
        elif stylizer.job.plan.precision not in WHOLE_FLOAT32:
            source = self.exact
        first = stylizer.measured[0]["novel_views"] if stylizer.measured else None
        return NovelViews(
            stylizer.job.views.cameras,
            stylizer.job.views.covered,
            scene,
            rasterizer,
            source.loss,
            source.style_targets,
            weighted=stylizer.job.plan.weighted,
            lpips=lpips or load_lpips_or_none(stylizer.job.network.device),
            memory=measuring_memory(stylizer.job.memory),
            first={int(scale): value for scale, value in first["gram"].items()} if first else None,
            most=views,
            rasterizer_of=partial(rasterizer_beside, stylizer),
            maps=stylizer.job.styles.maps(rasterizer),
        )


def make_novel_views(stylizer: Stylizer) -> NovelViews:
    """Create the novel views of a job, with all Gaussians of its scene."""
    exact = ExactLoss(stylizer, "sos")
    return NovelViews(
        stylizer.job.views.cameras,
        stylizer.job.views.covered,
        stylizer.job.scene,
        rasterizer_beside(stylizer, stylizer.job.scene),
        exact.loss,
        exact.style_targets,
        weighted=stylizer.job.plan.weighted,
        memory=measuring_memory(stylizer.job.memory),
    )


def make_judge(stylizer: Stylizer, novel_views: NovelViews, lpips: Lpips) -> Judge:
    """Create the judge of a job's colors on its novel views."""
    cameras = [novel_views.cameras[index] for index in novel_views.views]
    background = stylizer.job.settings.background
    return Judge(lpips, stylizer.job.styles, novel_views.scene, novel_views.rasterizer, cameras, background)
