"""Scales of a view, and their weights: E = sum_s w_s E_transfer(s) / sum_s w_s.

By default all weights are equal, so E is the mean over scales, as in the paper. Scales of weight 0 are not computed.
This module imports no PyTorch: the service estimates jobs with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sgsst_core.constants import COARSEST_SHORTER_SIDE
from sgsst_core.errors import SettingsError
from sgsst_core.settings import Settings

if TYPE_CHECKING:
    from sgsst_core.scene.camera import Camera


def scale_count(height: int, width: int, coarsest: int = COARSEST_SHORTER_SIDE) -> int:
    """Return the number of scales n_s: halve the shorter side (integer division) until it is at most `coarsest`.

    Small views have one scale.
    """
    count, side = 1, min(height, width)
    while side > coarsest:
        side //= 2
        count += 1
    return count


@dataclass(frozen=True)
class ScaleWeights:
    """Weights of the scales of a pyramid.

    Attributes:
        values: Weights from the finest scale (full size) to coarser ones, finite and non-negative. Scales beyond the
            last value have weight 0. Empty for equal weights.
    """

    values: tuple[float, ...] = ()

    def of(self, scale: int) -> float:
        """Return the weight of a scale; scale 0 is full size."""
        if not self.values:
            return 1.0
        return self.values[scale] if scale < len(self.values) else 0.0

    def chosen(self, count: int) -> list[int]:
        """Return the scales with a positive weight among the first `count`, finest first."""
        return [scale for scale in range(count) if self.of(scale) > 0]

    def fractions(self, scales: Iterable[int]) -> dict[int, float]:
        """Return the weights of some scales, normalized to add up to 1.

        Raises:
            ValueError: If none of them has a positive weight.
        """
        weights = {scale: self.of(scale) for scale in scales}
        total = sum(weights.values())
        if not total > 0:
            raise ValueError(f"none of the scales {sorted(weights)} has a weight")
        return {scale: weight / total for scale, weight in weights.items()}

    def sampled(self, chosen: Sequence[int], drawn: Iterable[int], period: int) -> dict[int, float]:
        """Return the weights of drawn scales whose mean over all draws (`schedule.drawn_scales`) is `fractions`.

        Args:
            chosen: Scales of a view with a positive weight, finest first.
            drawn: Those of them that a step evaluates.
            period: Number of steps with a scale of which one has the next finer scale.
        """
        fractions = self.fractions(chosen)
        return {scale: fractions[scale] * period ** (len(chosen) - 1 - chosen.index(scale)) for scale in drawn}

    def evaluated(self, count: int, period: int = 1) -> float:
        """Return the pixels that a mean step with `sampled` weights evaluates, relative to those of the view.

        Args:
            count: Number of scales of a view.
            period: See `sampled`; 1 for all scales in every step.
        """
        coarsest_first = reversed(self.chosen(count))
        return sum(4.0**-scale * float(period) ** -place for place, scale in enumerate(coarsest_first))

    def sampled_cost(self, count: int, period: int) -> float:
        """Return the cost of all scales but the coarsest in a mean step, relative to a step with all scales."""
        *finer, coarsest = self.chosen(count)
        always = 4.0**-coarsest
        return (self.evaluated(count, period) - always) / (self.evaluated(count) - always) if finer else 1.0

    def mean(self, losses: Mapping[int, float]) -> float:
        """Return E, the weighted mean of losses by scale. Every scale in `losses` must have a positive weight."""
        total = sum(self.of(scale) for scale in losses)
        return sum(self.of(scale) * loss for scale, loss in losses.items()) / total


#: Equal weights, as in the paper's loss.
EVEN = ScaleWeights()


def band_count(cameras: Sequence[Camera], settings: Settings) -> int:
    """Return the number of depth bands, which is that of the scales of the largest view; 0 without `stroke_depth`."""
    if not settings.stroke_depth:
        return 0
    return max(scale_count(camera.height, camera.width, settings.coarsest_side) for camera in cameras)


def check_stroke_depth(settings: Settings, cameras: Sequence[Camera], *, regions: bool) -> None:
    """Check that `stroke_depth` has scales to choose from, and no other weights to share positions with.

    Raises:
        SettingsError: If every view has one scale, or the job has regions or weights of scales.
    """
    if not settings.stroke_depth:
        return
    if regions or settings.scales:
        other = "--region" if regions else "--scales"
        raise SettingsError(f"--stroke-depth and {other} both weight positions. Leave one of them out.")
    if band_count(cameras, settings) == 1:
        raise SettingsError(
            "--stroke-depth needs views of at least two scales, but theirs have one: give larger views or a smaller "
            "--coarsest-side."
        )


def check_scales(weights: Sequence[float], cameras: Sequence[Camera], coarsest: int) -> None:
    """Check that every scale with a positive weight exists, and that every view has at least one such scale.

    Args:
        weights: Weights from the finest scale to coarser ones, at least one of them positive; empty for equal weights.
        coarsest: Maximum shorter side of the coarsest scale in pixels.

    Raises:
        SettingsError: If a scale with a positive weight exists in no view, or a view has no scale with a positive
            weight.
    """
    requested = ScaleWeights(tuple(weights))
    if not requested.values:
        return
    counts = {camera.name: scale_count(camera.height, camera.width, coarsest) for camera in cameras}
    most, last = max(counts.values()), max(scale for scale, weight in enumerate(weights) if weight > 0)
    if last >= most:
        have = "one scale, 0" if most == 1 else f"{most} scales, 0 to {most - 1}"
        raise SettingsError(
            f"--scales gives scale {last} a weight, but the views have {have} (full size): leave it out, or give "
            "larger views or a smaller --coarsest-side."
        )
    for name, count in counts.items():
        if not requested.chosen(count):
            raise SettingsError(
                f"--scales gives no weight to the {count} of {most} scales that view {name!r} has. Give one of them a "
                "weight, or use views of one size."
            )
