"""Which scales of the pyramid count, and how much: E = sum_s w_s E_transfer(s) / sum_s w_s over the scales of a view.

With equal weights of all scales, as always if nothing else was asked for, this is the paper's mean. A scale of weight 0
is not computed at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sgsst_core.errors import SettingsError
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.pyramid import scale_count


@dataclass(frozen=True)
class ScaleWeights:
    """Weights of a pyramid's scales.

    Attributes:
        values: from full size on, finite and not negative; scales beyond them have none. Empty: all count alike.
    """

    values: tuple[float, ...] = ()

    def of(self, scale: int) -> float:
        """The weight of a scale, 0 being full size."""
        if not self.values:
            return 1.0
        return self.values[scale] if scale < len(self.values) else 0.0

    def chosen(self, count: int) -> list[int]:
        """The scales that count of a view that has so many, the finest first."""
        return [scale for scale in range(count) if self.of(scale) > 0]

    def shares(self, scales: Iterable[int]) -> dict[int, float]:
        """What each of some scales counts of their loss; the shares add up to 1.

        Raises:
            ValueError: none of them has a weight.
        """
        weights = {scale: self.of(scale) for scale in scales}
        total = sum(weights.values())
        if not total > 0:
            raise ValueError(f"none of the scales {sorted(weights)} has a weight")
        return {scale: weight / total for scale, weight in weights.items()}

    def mean(self, losses: Mapping[int, float]) -> float:
        """E from the losses of scales. Only those that have a weight may be among them."""
        total = sum(self.of(scale) for scale in losses)
        return sum(self.of(scale) * loss for scale, loss in losses.items()) / total


#: All scales count alike: the paper's loss.
EVEN = ScaleWeights()


def check_scales(weights: Sequence[float], cameras: Sequence[Camera], coarsest: int) -> None:
    """Prove that the views have the scales that were asked for, and each view one of them.

    Args:
        weights: see `ScaleWeights`; at least one is positive.
        cameras: at the sizes that they are stylized at.
        coarsest: pixels of the coarsest scale's shorter side at most.

    Raises:
        SettingsError: otherwise.
    """
    asked = ScaleWeights(tuple(weights))
    if not asked.values:
        return
    counts = {camera.name: scale_count(camera.height, camera.width, coarsest) for camera in cameras}
    most, last = max(counts.values()), max(place for place, weight in enumerate(weights) if weight > 0)
    if last >= most:
        have = "one scale, 0" if most == 1 else f"{most} scales, 0 to {most - 1}"
        raise SettingsError(
            f"--scales gives scale {last} a weight, but the views have {have} (full size): leave it out, or give "
            "larger views or a smaller --coarsest-side."
        )
    for name, count in counts.items():
        if not asked.chosen(count):
            raise SettingsError(
                f"--scales leaves view {name!r} nothing: it has {count} of the views' {most} scales, and none of them "
                "has a weight. Give one of them a weight, or views of one size."
            )
