"""Quality comparison of several ways to run one job, each with the same time budget.

The variants are those of `error_time`. Their results are judged on novel views by a network that no variant optimizes
(`Judge`), and their remaining loss is reported. For comparison, the unstylized scene and a plain color transfer are
judged too. A variant is on the Pareto front if no other variant is better in both style and content.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgsst_core.bench.error_time import Curve, Variant, error_time
from sgsst_core.bench.error_time import as_dict as curves_as_dict
from sgsst_core.errors import SettingsError, WeightsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.quality.consistency import Consistency
from sgsst_core.quality.judge import Judge, Judgment
from sgsst_core.quality.lpips import MIN_SIDE, load_lpips_or_none
from sgsst_core.quality.measure import make_judge, make_novel_views
from sgsst_core.quality.novel_views import NovelViewMoment
from sgsst_core.report.charts import png_chart
from sgsst_core.report.contact_sheet import write_grid
from sgsst_core.report.palette import INK, color_of
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.color_transfer import warm_start
from sgsst_core.stylizing.stylizer import Stylizer

#: Names of the outcomes that are judged for comparison with the variants.
UNSTYLIZED, TRANSFER = "unstylized", "transfer"
#: Number of views in each row of the contact sheet.
_SHOWN = 3


@dataclass(frozen=True)
class VariantResult:
    """Result of one way to run the job.

    Attributes:
        name: Name of the variant, or `UNSTYLIZED`, or `TRANSFER`.
        sh_dc: Colors [N, 3].
        short, long: Consistency of views 1 and 7 apart; None if there is no such pair.
        loss: Remaining loss, relative to the unstylized scene; None if it was not measured.
    """

    name: str
    what: str
    sh_dc: Tensor
    judgment: Judgment
    short: Consistency | None
    long: Consistency | None
    loss: float | None = None
    steps: int = 0
    seconds: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the fields except the colors as JSON-serializable values."""
        ranges = {"short": self.short, "long": self.long}
        return {
            "name": self.name,
            "what": self.what,
            "loss": self.loss,
            "steps": self.steps,
            "seconds": self.seconds,
            **asdict(self.judgment),
            "consistency": {name: pairs and pairs.as_dict() for name, pairs in ranges.items()},
        }


@dataclass(frozen=True)
class Quality:
    """Result of a comparison.

    Attributes:
        outcomes: Unstylized scene, color transfer, and the variants.
        curves: Losses of each variant against seconds, or the reason why it was skipped.
        judge: Judge of the scene's colors; it can judge further colors.
    """

    outcomes: list[VariantResult]
    curves: list[Curve]
    judge: Judge
    style: Tensor

    def front(self) -> list[VariantResult]:
        """Return the stylized outcomes that no other outcome dominates in style and content, ordered by style."""
        front: list[VariantResult] = []
        stylized = [outcome for outcome in self.outcomes if outcome.name != UNSTYLIZED]
        for outcome in sorted(stylized, key=lambda one: (one.judgment.style, one.judgment.content)):
            if not front or outcome.judgment.content < front[-1].judgment.content:
                front.append(outcome)
        return front

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison as JSON-serializable values."""
        return {
            "views": [camera.name for camera in self.judge.cameras],
            "outcomes": [outcome.as_dict() for outcome in self.outcomes],
            "front": [outcome.name for outcome in self.front()],
            "error_time": curves_as_dict(self.curves),
        }


def compare_quality(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Tensor,
    variants: Sequence[Variant],
    seconds: float,
    *,
    weights: BackboneWeights | None = None,
    progress: Callable[[Curve], None] = lambda curve: None,
    **settings: Any,
) -> Quality:
    """Run variants on one scene, each with the same time budget, and judge the results.

    The arguments are those of `error_time`.

    Raises:
        WeightsError: If AlexNet is not installed.
        SettingsError: If no novel view can be judged.
    """
    lpips = load_lpips_or_none()
    if lpips is None:
        raise WeightsError("results are judged by AlexNet, which is not installed: run `sgsst weights fetch vgg16`.")
    stylizer = Stylizer.planned(scene, cameras, style, make_settings("standard", **settings), weights=weights)
    novel_views = make_novel_views(stylizer)
    judge = make_judge(stylizer, novel_views, lpips)
    if not judge.cameras:
        raise SettingsError(
            "no view between the cameras can be judged: neighboring cameras are too far apart, or views are smaller "
            f"than {MIN_SIDE} pixels. Give more cameras, or larger views."
        )
    novel_views.lpips = lpips

    def outcome(name: str, what: str, sh_dc: Tensor) -> VariantResult:
        moment: NovelViewMoment = novel_views.measure(sh_dc)
        judgment = judge.judge(sh_dc)
        assert judgment is not None
        return VariantResult(name, what, sh_dc, judgment, moment.short, moment.long)

    blend_weights = stylizer.job.plan.survey.total_blend_weights
    transferred = warm_start(scene.sh_dc, blend_weights, Style.of(style))
    outcomes = [
        outcome(UNSTYLIZED, "the unstylized scene", scene.sh_dc),
        outcome(TRANSFER, "the style's distribution of colors, no step", transferred),
    ]
    curves = error_time(scene, cameras, style, variants, seconds, weights=weights, progress=progress, **settings)
    for curve in curves:
        if curve.sh_dc is not None:
            last = curve.points[-1]
            last_outcome = outcome(curve.variant.name, curve.variant.what, curve.sh_dc)
            outcomes.append(replace(last_outcome, loss=last.relative, steps=last.step, seconds=last.seconds))
    return Quality(outcomes, curves, judge, style)


def write_plot(path: Path, quality: Quality, title: str) -> None:
    """Write a PNG of style against content, with the Pareto front as a dashed line; lower left is better.

    Raises:
        OutputError: If the file cannot be written.
    """
    with png_chart(path, (7, 5)) as figure:
        axes = figure.subplots()
        for index, outcome in enumerate(quality.outcomes):
            point = (outcome.judgment.content, outcome.judgment.style)
            axes.plot(*point, "o", color=color_of(index), clip_on=False)
            axes.annotate(outcome.name, point, xytext=(5, 4), textcoords="offset points", color=INK)
        front = [outcome.judgment for outcome in quality.front()]
        axes.plot([one.content for one in front], [one.style for one in front], "--", color=INK, alpha=0.5)
        axes.set_xlabel("content lost (LPIPS)")
        axes.set_ylabel("distance to the style (AlexNet's Gram matrices)")
        axes.margins(0.15)
        figure.suptitle(f"{title} (dashed: Pareto front)")


def write_sheet(path: Path, quality: Quality) -> None:
    """Write a JPEG with the style and a row per outcome; see `judged_row`.

    Raises:
        OutputError: If the file cannot be written.
    """
    rows = [judged_row(quality.judge, outcome.name, outcome.sh_dc) for outcome in quality.outcomes]
    with torch.no_grad():
        write_grid(path, [[("style", quality.style)], *rows])


def judged_row(judge: Judge, name: str, sh_dc: Tensor) -> list[tuple[str, Tensor]]:
    """Return the row of some colors in a contact sheet: some views on black, and the first one on white."""
    (first, on_white), *others = [judge.renders(sh_dc, camera) for camera in judge.cameras[:_SHOWN]]
    return [(name, first), *(("", on_black) for on_black, _ in others), ("", on_white)]
