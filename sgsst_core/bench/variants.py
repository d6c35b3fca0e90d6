"""Comparison of several ways to run one job, each with the same time budget.

Every variant runs its own schedule for the same number of seconds. Each point is the result of a job with
`within`, without early stop. At fixed times, its colors are evaluated on some views by the float32 loss of all
scales (`Float32Reference`). This is the paper's loss, regardless of the loss that the variant optimizes. At the
same times, they are judged on novel views by a network that no variant optimizes (`Judge`). Run time excludes
evaluations and judgments. It also excludes the one-time preparation of each view, which would dominate a short budget
and is reported separately. All variants are in memory at the same time. A variant is on the Pareto front of error and
time if it reaches some loss sooner than all others, and on that of quality if none is better in both style and content.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from sgsst_core.budget import default_memory_limit
from sgsst_core.errors import SettingsError, WeightsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.planning.plan import LOSS_VIEWS
from sgsst_core.quality.judge import MIN_SIDE, Judge, Judgment, Lpips, load_lpips_or_none
from sgsst_core.quality.measure import Float32Reference, make_judge, make_novel_views
from sgsst_core.quality.novel_views import Consistency, NovelViewMoment
from sgsst_core.report import page
from sgsst_core.report.images import INK, color_of, write_grid
from sgsst_core.scales import ratio
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PresetName, Settings, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.styles import warm_start
from sgsst_core.stylizing.stylizer import Stylizer, relative_loss

if TYPE_CHECKING:
    from matplotlib.axes import Axes

T = TypeVar("T")

#: Number of slices of the time budget. Variants take turns slice by slice, so that a temporary slowdown of the machine
#: affects all of them.
SLICES = 32
#: Numbers of slices after which the variants are evaluated.
MOMENTS = (1, 2, 4, 8, 16, 32)
#: Markers of curves. Their number (7) and the number of colors (6) have no common divisor, so up to 42 variants have
#: distinct combinations of marker and color.
_MARKERS = "osD^vP*"
#: Title of the panel of the mean loss; measures of the judgment that the plot shows, with their titles.
_MEAN = "mean of the scales"
_JUDGED = {"style": "distance from the style (AlexNet)", "color_distance": "color distance"}
#: Names of the outcomes that are judged for comparison with the variants.
UNSTYLIZED, TRANSFER = "unstylized", "transfer"
#: Number of views in each row of the contact sheet.
_SHOWN = 3


@dataclass(frozen=True)
class Variant:
    """One way to run the job.

    Attributes:
        name: Name for `--variants`.
        settings: Settings that override the standard preset.
    """

    name: str
    what: str
    settings: dict[str, Any] = field(default_factory=dict)


def _of_preset(preset: PresetName) -> dict[str, Any]:
    """Return the settings of a preset that differ from the standard preset's."""
    standard, other = make_settings("standard"), make_settings(preset)
    pairs = {name: (getattr(standard, name), getattr(other, name)) for name in Settings.model_fields}
    return {name: value for name, (usual, value) in pairs.items() if value != usual}


VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("standard", "all scales (SOS), the finer ones in some visits of a view; the standard preset"),
        Variant("preview", "the preview preset: views of at most 640 pixels", _of_preset("preview")),
        Variant("paper", "the paper preset: published schedule, rate and start", _of_preset("paper")),
        Variant(
            "paper-rate",
            "standard with the paper's constant learning rate and clamp",
            {"learning_rate": 2.5e-3, "learning_rate_end": 2.5e-3, "clamp_aware_gradient": False},
        ),
        Variant("all-scales", "all scales in every step", {"scale_sampling": 1}),
        Variant("coarse-only", "the coarsest scale alone", {"steps_coarse": 300, "steps_sos": 0}),
        Variant("one-scale", "the paper's loss at full size alone", {"scales": (1.0,)}),
        Variant("cold-start", "standard, from the scene's own colors", {"warm_start": False}),
        Variant(
            "fixed-background",
            "standard, with the background behind every step",
            settings={"training_background": "background"},
        ),
        Variant(
            "random-background",
            "standard, with a random color behind each step",
            settings={"training_background": "random"},
        ),
        Variant(
            "no-clamp-aware-gradient",
            "standard; colors that fall below 0 stay there",
            settings={"clamp_aware_gradient": False},
        ),
        Variant("float32", "standard with features in float32", {"precision": "float32"}),
        Variant("winograd", "standard with convolutions by Winograd's algorithm", {"precision": "winograd"}),
        Variant("bfloat16", "standard with features in bfloat16", {"precision": "bfloat16"}),
        Variant("tf32", "standard with TF32 convolutions", {"precision": "tf32"}),
        Variant("half-weights", "standard with blend weights in half precision", {"cached_weights": "half"}),
        Variant("no-cached-weights", "standard, with recomputed blend weights", {"cached_weights": "none"}),
        Variant("two-views", "standard with two views in each step", {"views_per_step": 2}),
        Variant("nnfm", "standard with ARF's nearest-neighbor style loss", {"style_loss": "nnfm"}),
        Variant("mixed", "standard with nearest neighbors beside the statistics", {"style_loss": "mixed"}),
    )
}


@dataclass(frozen=True)
class Point:
    """Evaluation of a variant.

    Attributes:
        relative: Loss relative to the unstylized scene, mean over scales; None if the latter is 0.
        by_scale: Relative loss of each scale; None where that of the unstylized scene is 0.
        judgment: Judgment on the novel views; None if AlexNet is not installed, or if no view can be judged.
    """

    seconds: float
    step: int
    relative: float | None
    by_scale: dict[int, float | None]
    judgment: Judgment | None = None


@dataclass(frozen=True)
class Curve:
    """Results of a variant. If it was skipped, `points` is empty and `left_out` states the reason."""

    variant: Variant
    points: list[Point]
    preparation: float = 0.0  # in seconds
    left_out: str | None = None
    sh_dc: Tensor | None = None  # final colors [N, 3]


def choose_variants(names: Sequence[str]) -> list[Variant]:
    """Return the variants with the given names, or all variants if there are none.

    Raises:
        SettingsError: If a name is unknown.
    """
    unknown = [name for name in names if name not in VARIANTS]
    if unknown:
        raise SettingsError(f"There is no variant {', '.join(unknown)}. Choose from {', '.join(VARIANTS)}.")
    return [VARIANTS[name] for name in names or VARIANTS]


def error_time(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Tensor,
    variants: Sequence[Variant],
    seconds: float,
    *,
    weights: BackboneWeights | None = None,
    progress: Callable[[Curve], None] = lambda curve: None,
    **settings: Any,
) -> list[Curve]:
    """Run variants on one scene, each with the same time budget or until its last step.

    Args:
        seconds: Seconds of optimization per variant.
        progress: Function called after each evaluation, with the curve so far.
        settings: Settings for all variants that override the standard preset.
    """
    base = make_settings("standard", **settings)
    fraction = (base.memory_limit or default_memory_limit()) // (len(variants) + 1)
    base = base.model_copy(update={"memory_limit": fraction})
    reference = Stylizer.planned(scene, cameras, style, base, weights=weights)
    exact = Float32Reference(reference, style_loss="sos")
    lpips = load_lpips_or_none()
    judge = make_judge(reference, make_novel_views(reference), lpips) if lpips else None
    views = spread(exact.views.covered, LOSS_VIEWS)
    start = exact.evaluate(views, scene.sh_dc)
    running = [_prepared(variant, (scene, cameras, style), base, weights) for variant in variants]

    def evaluated(stylizer: Stylizer) -> Point:
        colors = stylizer.stylized()
        loss, judgment = exact.evaluate(views, colors), judge.judge(colors) if judge else None
        by_scale = {scale: ratio(loss[scale].total, start[scale].total) for scale in loss}
        relative = relative_loss(start, loss, exact.loss.weights)
        return Point(stylizer.seconds, stylizer.step, relative, by_scale, judgment)

    for part in range(1, SLICES + 1):
        for curve, stylizer in running:
            if stylizer is None:
                continue
            while stylizer.seconds < part / SLICES * seconds and stylizer.step < stylizer.job.total_steps:
                stylizer.run_step()
            if part in MOMENTS:
                last = curve.points[-1] if curve.points else None
                curve.points.append(last if last and last.step == stylizer.step else evaluated(stylizer))
                progress(curve)
    return [replace(curve, sh_dc=stylizer.stylized() if stylizer else None) for curve, stylizer in running]


def _prepared(
    variant: Variant,
    inputs: tuple[Scene, Sequence[Camera], Tensor],
    base: Settings,
    weights: BackboneWeights | None,
) -> tuple[Curve, Stylizer | None]:
    """Prepare a variant to run: the style and every view, as the first steps would.

    Returns an empty curve, and the stylizer of the variant. If the variant is skipped, the stylizer is None and the
    curve states the reason.
    """
    settings = base.model_copy(update=variant.settings)
    try:
        stylizer = Stylizer.planned(*inputs, settings, weights=weights)
    except SettingsError as error:  # a precision that this machine lacks
        return Curve(variant, [], left_out=str(error)), None
    started = time.perf_counter()
    for index in stylizer.job.views.covered:
        chosen = stylizer.job.scales(index)
        stylizer.job.style_targets(stylizer.job.views.cameras[index])
        scales = sorted({scale for phase in stylizer.job.schedule for scale in phase.scales(chosen)})
        stylizer.job.view_targets.target(index, scales, stylizer.drawn_background(index))
        stylizer.job.views.cache_weights(index)
        stylizer.job.views.render(index, stylizer.job.views.colors(index, stylizer.sh_dc.detach()))
    return Curve(variant, [], preparation=time.perf_counter() - started), stylizer


def undominated(items: Iterable[T], measures: Callable[[T], tuple[float, float]]) -> list[T]:
    """Return the items that no other one dominates in both measures, ordered by the first; lower is better."""
    front: list[T] = []
    for item in sorted(items, key=measures):
        if not front or measures(item)[1] < measures(front[-1])[1]:
            front.append(item)
    return front


def pareto_front(curves: Sequence[Curve]) -> list[tuple[str, Point, float]]:
    """Return the points that no other point dominates in seconds and loss, ordered by seconds, with their losses."""
    points = [(curve.variant.name, point, point.relative) for curve in curves for point in curve.points]
    known = [(name, point, relative) for name, point, relative in points if relative is not None]
    return undominated(known, lambda item: (item[1].seconds, item[2]))


def as_dict(curves: Sequence[Curve]) -> dict[str, Any]:
    """Return the curves and their Pareto front as JSON-serializable values."""
    return {
        "variants": {
            curve.variant.name: {
                "what": curve.variant.what,
                "left_out": curve.left_out,
                "preparation_seconds": round(curve.preparation, 3),
                "points": [asdict(point) for point in curve.points],
            }
            for curve in curves
        },
        "pareto_front": [
            {"variant": name, "seconds": round(point.seconds, 3), "relative": relative}
            for name, point, relative in pareto_front(curves)
        ],
    }


def write_plot(path: Path, curves: Sequence[Curve], title: str) -> None:
    """Write a PNG of loss and judgments against seconds on logarithmic axes.

    There is a panel for the mean loss over scales, one for each scale, and one for each judgment.

    Raises:
        OutputError: If the file cannot be written.
    """
    shown = [curve for curve in curves if curve.points]
    points = [point for curve in shown for point in curve.points]
    titles = list(dict.fromkeys([_MEAN, *(panel for point in points for panel in _measures(point))]))
    losses = len([panel for panel in titles if panel not in _JUDGED.values()])
    with page.png_chart(path, (5.2 * len(titles), 4.8)) as figure:
        every = figure.subplots(1, len(titles), squeeze=False)[0]
        for index, (axes, panel) in enumerate(zip(every, titles, strict=True)):
            if 0 < index < losses:
                axes.sharey(every[0])
            _draw_curves(axes, shown, panel)
        front = pareto_front(shown)
        seconds, relative = [point.seconds for _, point, _ in front], [loss for *_, loss in front]
        every[0].plot(seconds, relative, "--", color=INK, lw=2.5, alpha=0.35)
        every[0].set_ylabel(page.RELATIVE_LOSS)
        page.draw_legend(figure, in_row=7)
        figure.suptitle(f"{title} (dashed: Pareto front)")


def _measures(point: Point) -> dict[str, float | None]:
    """Return what the plot shows of a point, by the title of its panel: losses first, then judgments."""
    scales = {page.scale_name(scale): loss for scale, loss in sorted(point.by_scale.items())}
    judged = {title: getattr(point.judgment, name) for name, title in _JUDGED.items()} if point.judgment else {}
    return {_MEAN: point.relative, **scales, **judged}


def _draw_curves(axes: "Axes", curves: Sequence[Curve], title: str) -> None:
    """Draw a measure of points against seconds with one line per curve."""
    for index, curve in enumerate(curves):
        values = page.column([_measures(point).get(title) for point in curve.points])
        if (values > 0).any():
            axes.plot(
                [point.seconds for point in curve.points],
                values,
                marker=_MARKERS[index % len(_MARKERS)],
                markersize=4,
                linewidth=1,
                color=color_of(index),
                label=curve.variant.name,
                clip_on=False,
            )
    page.set_log(axes, "seconds of optimization")
    axes.set_title(title)


@dataclass(frozen=True)
class VariantResult:
    """Result of one way to run the job.

    Attributes:
        name: Name of the variant, or `UNSTYLIZED`, or `TRANSFER`.
        sh_dc: Colors [N, 3].
        short, long: Short- and long-range consistency; None if there is no such pair.
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
            "consistency": {name: pairs and asdict(pairs) for name, pairs in ranges.items()},
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
        stylized = [outcome for outcome in self.outcomes if outcome.name != UNSTYLIZED]
        return undominated(stylized, lambda one: (one.judgment.style, one.judgment.content))

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison as JSON-serializable values."""
        return {
            "views": [camera.name for camera in self.judge.cameras],
            "lpips": Lpips.network,
            "outcomes": [outcome.as_dict() for outcome in self.outcomes],
            "front": [outcome.name for outcome in self.front()],
            "error_time": as_dict(self.curves),
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
    novel_views = make_novel_views(stylizer, lpips=lpips)
    judge = make_judge(stylizer, novel_views, lpips)
    if not judge.cameras:
        raise SettingsError(
            "no view between the cameras can be judged: neighboring cameras are too far apart, or views are smaller "
            f"than {MIN_SIDE} pixels. Give more cameras, or larger views."
        )

    def outcome(name: str, what: str, sh_dc: Tensor) -> VariantResult:
        moment: NovelViewMoment = novel_views.measure(sh_dc)
        judgment = judge.judge(sh_dc)
        assert judgment is not None
        return VariantResult(name, what, sh_dc, judgment, moment.short, moment.long)

    transferred = warm_start(scene.sh_dc, stylizer.job.plan.survey.total_blend_weights, Style.of(style))
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


def write_quality_plot(path: Path, quality: Quality, title: str) -> None:
    """Write a PNG of style against content, with the Pareto front as a dashed line; lower left is better.

    Raises:
        OutputError: If the file cannot be written.
    """
    with page.png_chart(path, (7, 5)) as figure:
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
