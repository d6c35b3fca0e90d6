"""What a run measures at moments between its steps: held-out views, and its approximations against exact."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

from torch import Tensor

from sgsst_core.planning.measuring import LEVELS, Level, Prices, choose_level, held_out_seconds
from sgsst_core.quality.exact import ExactTwin, approximations
from sgsst_core.quality.held_out import HeldOut
from sgsst_core.quality.lpips import Lpips, load_lpips_or_none
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.stylizing.evaluation import Evaluation
from sgsst_core.stylizing.stylizer import Stylizer

#: Seconds that compiling kernels may take on a machine where nothing has been compiled yet.
_COMPILING = 60.0


@dataclass(frozen=True)
class _Affordable:
    """What prices allow: place in `LEVELS`, seconds of a moment after the first; whether prices may have been wrong."""

    place: int
    again: float
    once_more: bool


class Measurements:
    """Measures a job; pass an object of this as `loop.Callbacks.measure`.

    Everything is built at first use. Results go to `Stylizer.measured`, one entry a moment, ready for JSON: "step",
    "held_out" and "approximation" (None where there is nothing to measure), the "seconds" it took. How much is measured
    is the plan's, or less where the first view takes longer than it thought: decided once, by the first rank, and kept
    in the first entry with what a moment takes after it ("level", "again").

    Args:
        stylizer: the job, at any step.
    """

    def __init__(self, stylizer: Stylizer) -> None:
        self._stylizer = stylizer
        self.approximated = approximations(stylizer)
        self._exact: ExactTwin | None = None
        self._held_out: HeldOut | None = None

    @property
    def exact(self) -> ExactTwin:
        """The exact twin."""
        if self._exact is None:
            self._exact = ExactTwin(self._stylizer, self._stylizer.memory // 16)
        return self._exact

    @property
    def level(self) -> Level:
        """How much is measured."""
        measured = self._stylizer.measured
        # Entries of before there were levels: all.
        return LEVELS[measured[0].get("level", 0) if measured else self._stylizer.plan.measuring]

    @property
    def moments(self) -> list[int]:
        """Steps after which the job is measured; none without a share of its time."""
        stylizer = self._stylizer
        return self.level.moments(stylizer.total) if stylizer.settings.measure else []

    def due(self, step: int) -> bool:
        """Whether the job is to be measured after so many steps."""
        return step in self.moments

    def seconds_left(self, step: int) -> float:
        """What the moments after so many steps will take, and the loss at the end."""
        expected, measured = self._stylizer.plan.prediction, self._stylizer.measured
        left = sum(moment >= step and not (measured and moment == measured[-1]["step"]) for moment in self.moments)
        price: float
        before = 2 * expected.evaluation if expected else 0.0
        known: list[float] = [entry["seconds"] for entry in measured[1:] if "seconds" in entry]
        if known:
            price = median(known)
        elif measured and "again" in measured[0]:
            price = measured[0]["again"]
        else:
            price = (expected.measuring - before) / max(len(self.moments), 1) if expected else 0.0
        return left * max(price, 0.0) + before / 2

    def evaluate(self, *, unstylized: bool = False) -> Evaluation:
        """Exact loss on the evaluation views, of the present colours or of the unstylized scene."""
        stylizer = self._stylizer
        with self._counted():
            if not self.approximated:
                return stylizer.start() if unstylized else stylizer.evaluate(stylizer.evaluation_views)
            colours = stylizer.scene.sh_dc if unstylized else stylizer.stylized()
            return self.exact.evaluate(stylizer.evaluation_views, colours)

    def at_the_end(self) -> None:
        """Measure the last moment, wherever the job has ended, unless that has been done."""
        stylizer = self._stylizer
        if stylizer.settings.measure and not (stylizer.measured and stylizer.measured[-1]["step"] == stylizer.step):
            self(stylizer)

    def __call__(self, stylizer: Stylizer) -> None:
        """Measure now."""
        with self._counted():
            started = time.perf_counter()
            approximation = self.exact.gradient_error().as_dict() if self.approximated else None
            seconds = time.perf_counter() - started
            colours = stylizer.stylized() if stylizer.step else stylizer.scene.sh_dc
            own: dict[str, Any] = {}
            if not stylizer.measured:
                own = self._first(colours, seconds)
            moment = self._moment(colours, own)
            entry = {"step": stylizer.step, "held_out": moment, "approximation": approximation, **own}
            entry["seconds"] = time.perf_counter() - started
        stylizer.measured.append(entry)

    @contextmanager
    def _counted(self) -> Iterator[None]:
        """Count the seconds beside those of the steps."""
        started, parts = time.perf_counter(), self._stylizer.seconds_by_part
        yield
        parts["measuring"] = parts.get("measuring", 0.0) + time.perf_counter() - started

    def _moment(self, colours: Tensor, own: dict[str, Any]) -> dict[str, Any] | None:
        """Held-out views with colours [N, 3]; None without any. `own`: what the first entry holds."""
        stylizer, held_out = self._stylizer, self._of_held_out_views()
        if own:
            own["held_out_views"] = [held_out.cameras[index].name for index in held_out.views]
            own["lpips"] = held_out.lpips.network if held_out.lpips else None
            own["approximated"] = self.approximated
        if not held_out.views:
            return None
        measured = held_out.measure(colours.to(held_out.rasterizer.device))
        first = stylizer.measured[0] if stylizer.measured else {"step": stylizer.step}
        if first["step"]:  # there is no start to compare it with
            measured = replace(measured, gram_relative=None)
        return measured.as_dict(stylizer.step, stylizer.seconds)

    def _first(self, colours: Tensor, seconds: float) -> dict[str, Any]:
        """How much is measured, from what one view of it takes; seconds: of the gradient's error."""
        stylizer, place = self._stylizer, self._stylizer.plan.measuring
        again = 0.0
        if stylizer.step < stylizer.total and LEVELS[place] is not LEVELS[-1]:
            held_out, prices = self._trial(colours, seconds)
            if held_out.views:
                found = stylizer.collectives.broadcast(lambda: self._affordable(place, prices))
                if found.once_more:
                    if self.approximated:
                        started = time.perf_counter()
                        self.exact.gradient_error()
                        seconds = time.perf_counter() - started
                    prices = self._trial(colours, seconds)[1]
                    found = stylizer.collectives.broadcast(lambda: self._affordable(place, prices))
                place, again = found.place, found.again
            if LEVELS[place].views == 1:
                self._held_out = held_out
        if self._held_out is None:
            self._held_out = self._make(LEVELS[place].views)
        return {"level": place, "again": again}

    def _trial(self, colours: Tensor, seconds: float) -> tuple[HeldOut, Prices]:
        """One view of colours [N, 3], measured, and its price; seconds: of the gradient's error."""
        lpips = load_lpips_or_none(self._stylizer.network.device)  # is not what a view takes
        started = time.perf_counter()
        held_out = self._make(1, lpips)
        ready = time.perf_counter()
        if held_out.views:
            held_out.measure(colours.to(held_out.rasterizer.device))
        return held_out, Prices(ready - started, time.perf_counter() - ready, seconds)

    def _affordable(self, place: int, prices: Prices) -> _Affordable:
        """The level that these prices allow, from the plan's on.

        Kernels are compiled at first use: where a price may be that of compiling, it is found once more.
        """
        stylizer = self._stylizer
        expected, found = stylizer.plan.prediction, place
        if expected is not None:
            allowed = held_out_seconds(stylizer.settings.measure, expected)
            found = choose_level(prices, allowed, stylizer.total, place)
        quick = prices.setup + prices.view + prices.moment < _COMPILING
        return _Affordable(found, prices.again(LEVELS[found]), found != place and quick)

    def _of_held_out_views(self) -> HeldOut:
        if self._held_out is None:
            self._held_out = self._make(self.level.views)
        return self._held_out

    def _make(self, views: int, lpips: Lpips | None = None) -> HeldOut:
        """Held-out views, at most so many."""
        stylizer = self._stylizer
        scene = stylizer.scene.without_zero_bands()
        settings = stylizer.settings
        source = self.exact if stylizer.network.precision != "float32" else stylizer
        first = stylizer.measured[0]["held_out"] if stylizer.measured else None
        return HeldOut(
            stylizer.views.cameras,
            stylizer.views.covered,
            scene,
            make_rasterizer(stylizer.plan.anew, scene, background=settings.background, near=settings.near),
            source.loss,
            source.style_targets,
            weighted=stylizer.plan.weighted,
            lpips=lpips or load_lpips_or_none(stylizer.network.device),
            memory=stylizer.memory // 16,
            first={int(scale): value for scale, value in first["gram"].items()} if first else None,
            most=views,
        )
