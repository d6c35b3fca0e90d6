"""Immutable context of a stylization: plan, settings and styles of a job, and the objects made from its inputs."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import scipy  # imports its modules at first use
import torch
from torch import Tensor

from sgsst_core.budget import Cache, forget_device_peak, memory_for
from sgsst_core.devices import Timer
from sgsst_core.errors import DeviceMemoryError, SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.loss.graphs import LossGraphs
from sgsst_core.loss.sos import SosLoss, SosResult, make_loss
from sgsst_core.loss.terms import StyleTargets, ViewTarget, combined
from sgsst_core.orbit import Orbit
from sgsst_core.parallel.collectives import ALONE, Collectives, Team
from sgsst_core.parallel.division import Size
from sgsst_core.planning.plan import Plan, PlanningContext, ends_with_transfer, make_network, sharing_memory
from sgsst_core.planning.time_budget import TimeChoice
from sgsst_core.progress import Decision
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.base import Color
from sgsst_core.rasterizer.triton import CachedRasterizer
from sgsst_core.refine import Refinement
from sgsst_core.regions import ContentMaps, RegionMaps, Regions
from sgsst_core.scene.camera import Camera, fit_cameras, spread
from sgsst_core.scene.colors import ColorSubspace, color_subspace_of, style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import MAX_RESOLUTION, Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.color_transfer import in_colors_of, in_luminance_of, luminance_start, warm_start
from sgsst_core.stylizing.steps import Phase
from sgsst_core.stylizing.views import PhotoLoader, Views, ViewTargets

T = TypeVar("T")


@dataclass(frozen=True)
class JobInputs:
    """Inputs of a job, the same on every rank.

    Attributes:
        scene: Scene to stylize, after refinement if there was one.
        cameras: Cameras of the views; larger ones are reduced to `settings.max_resolution`.
        weights: Weights of the feature network.
        photos: Function that loads the content image of a camera by its index, at the (reduced) size of the view; None
            for unstylized renders.
        regions: Regions of the scene, each with its own style or frozen; None for one style everywhere.
        rasterizer: Rasterizer that computes blend weights: "cpu", "triton" or "reference". None to choose one.
        measured: Whether quality is measured and a report is written, as in `sgsst stylize`.
        orbit: Orbit that produced the cameras, for the plan to report; None for cameras from files.
        about_inputs: Decisions about cameras and photos that start the plan.
        refinement: Refinement that produced the scene, for the plan to report; None if it was not refined.
        chosen: Choice of the time budget, to which `cameras` and `photos` belong (`choose_within`); None without one.
    """

    scene: Scene
    cameras: Sequence[Camera]
    style: Style
    settings: Settings
    weights: BackboneWeights
    photos: PhotoLoader | None = None
    regions: Regions | None = None
    rasterizer: str | None = None
    measured: bool = False
    orbit: Orbit | None = None
    about_inputs: Sequence[Decision] = ()
    refinement: Refinement | None = None
    chosen: TimeChoice | None = None

    def refined(self, refinement: Refinement | None, scene: Scene | None = None) -> JobInputs:
        """Return the inputs with their scene refined, unless `scene` is the refined scene."""
        if refinement is None:
            return self
        regions = self.regions and self.regions.refined(refinement)
        return replace(self, scene=scene or refinement.of(self.scene), regions=regions, refinement=refinement)


@dataclass(frozen=True)
class JobStyles:
    """Styles of a job, prepared as its settings require.

    Attributes:
        own: Default style; if one region contains everything that the views show, the style of that region.
        each: Style of each region in `Regions.active`; empty if views need no region maps.
        content_weights: [N], content weight of each Gaussian; None for that of the settings everywhere.
    """

    own: Style
    regions: Regions | None = None
    each: tuple[Style, ...] = ()
    content_weights: Tensor | None = None

    @staticmethod
    def prepared(
        style: Style, regions: Regions | None, settings: Settings, sh_dc: Tensor, weights: Tensor
    ) -> JobStyles:
        """Prepare styles as the settings require; see `prepared_style`.

        Args:
            regions: Result of `Regions.resolved`; None if there are no regions.
            sh_dc: [N, 3], colors of the scene. A region's style may be matched to the colors of the region's own
                Gaussians.
            weights: [N] float64, total blend weights.
        """
        if regions is None:
            return JobStyles(prepared_style(style, settings, sh_dc, weights))
        content_weights, labels = regions.content_weights(settings.content_weight), regions.style_labels
        by_region = [regions.every[index].style or style for index in regions.active]
        if not regions.mapped:
            own = prepared_style(by_region[0], settings, sh_dc, weights)
            return JobStyles(own, regions, content_weights=content_weights)
        each = [
            prepared_style(own, settings, sh_dc, torch.where(labels == index, weights, 0.0))
            for index, own in zip(regions.active, by_region, strict=True)
        ]
        rest = each[regions.active.index(0)] if 0 in regions.active else prepared_style(style, settings, sh_dc, weights)
        return JobStyles(rest, regions, tuple(each), content_weights=content_weights)

    @property
    def content_weight(self) -> float | None:
        """Largest content weight of a Gaussian; None for that of the settings."""
        return None if self.content_weights is None else float(self.content_weights.max())

    def color_subspace(self, settings: Settings) -> ColorSubspace | None:
        """Return the color subspace of the job; None if colors are free."""
        return color_subspace_of(self.all, settings)

    @property
    def all(self) -> list[Style]:
        """All distinct styles in use."""
        styles: list[Style] = []
        for style in self.each or (self.own,):
            if all(style is not other for other in styles):
                styles.append(style)
        return styles

    def to(self, device: torch.device) -> JobStyles:
        """Return the styles with their images on a device."""

        def move(style: Style) -> Style:
            return style.map(lambda image: image.to(device))

        return replace(self, own=move(self.own), each=tuple(map(move, self.each)))

    def cached_targets(self, loss: SosLoss) -> Callable[[Camera], StyleTargets]:
        """Return a function that returns the targets for views of a camera's size, computed at first use."""
        styles = self.to(loss.network.device)
        targets = functools.cache(functools.partial(styles.targets, loss))
        return lambda camera: targets((camera.height, camera.width))

    def targets(self, loss: SosLoss, view_size: Size) -> StyleTargets:
        """Compute the targets for views of a size (height, width); see `TargetBuilder.of_style`."""
        if not self.each:
            return loss.targets.of_style(self.own, view_size)
        assert self.regions is not None
        weights = [self.regions.every[index].weight for index in self.regions.active]
        targets = [loss.targets.of_style(style, view_size) for style in self.each]
        return combined(targets, weights)

    def transferred(self, sh_dc: Tensor, weights: Tensor, rows: Tensor, *, preserve_chroma: bool = False) -> Tensor:
        """Transfer to each Gaussian the colors of its region's style; see `warm_start`.

        Args:
            sh_dc: [n, 3], colors of some of the scene's Gaussians.
            weights: [n] float64, total blend weights.
            rows: [N] bool, mask of these Gaussians.
            preserve_chroma: Whether to change luminance only.

        Returns:
            [n, 3].
        """
        transfer = luminance_start if preserve_chroma else warm_start
        if not self.each:
            return transfer(sh_dc, weights, self.own)
        assert self.regions is not None
        result, labels = sh_dc.clone(), self.regions.style_labels[rows]
        for index, style in zip(self.regions.active, self.each, strict=True):
            own = labels == index
            if bool((weights[own] > 0).any()):
                result[own] = transfer(sh_dc[own], weights[own], style)
        return result

    def maps(self, rasterizer: Rasterizer, rows: Tensor | None = None) -> RegionMaps | None:
        """Return the renderer of the maps of regions; None if the views need none.

        Args:
            rows: [N] bool, Gaussians that the rasterizer contains; None for all.
        """
        if not self.each:
            return None
        assert self.regions is not None
        labels = self.regions.style_labels if rows is None else self.regions.style_labels[rows]
        return RegionMaps(labels, self.regions.active, rasterizer)

    def content_maps(self, rasterizer: Rasterizer, rows: Tensor | None = None) -> ContentMaps | None:
        """Return the renderer of content weights; None if they are the same everywhere. See `maps` for arguments."""
        if not self.content_weight or self.content_weights is None:
            return None
        return ContentMaps(self.content_weights if rows is None else self.content_weights[rows], rasterizer)


def prepared_style(style: Style, settings: Settings, sh_dc: Tensor, weights: Tensor) -> Style:
    """Prepare a style as the settings require. If they require nothing, return the style itself.

    Args:
        style: Images [H, W, 3] in 0..1.
        sh_dc: [N, 3], colors of the scene.
        weights: [N] float64, total blend weights, at least one positive.
    """
    if settings.style_rotation:
        style = style.map(lambda image: rotated(image, settings.style_rotation))
    if settings.preserve_colors == "match":
        # Gatys, Ecker, Bethge, Hertzmann, Shechtman, "Controlling Perceptual Factors in Neural Style Transfer", CVPR
        # 2017, section 5.2.
        style = in_colors_of(style, sh_dc, weights)
    elif settings.preserve_colors == "luminance":
        style = in_luminance_of(style, sh_dc, weights)  # section 5.1 of the same paper
    return style


def check_style_size(style: Style, cameras: Sequence[Camera], scale: float) -> None:
    """Check that no view requires a style image with a longer side of more than `MAX_RESOLUTION` pixels.

    Raises:
        SettingsError: If an image would be larger.
    """
    if scale <= 1:
        return
    sizes = {(camera.height, camera.width) for camera in cameras}
    for size, image in itertools.product(sizes, style.images):
        height, width = style_size((image.shape[0], image.shape[1]), size, scale)
        if max(height, width) > MAX_RESOLUTION:
            raise SettingsError(
                f"--style-scale {scale:g} would make the style image {width:,} x {height:,} pixels for views of "
                f"{size[1]} x {size[0]}. Its longer side must be at most {MAX_RESOLUTION:,}. Use a smaller scale."
            )


def rotated(style: Tensor, degrees: float) -> Tensor:
    """Rotate an image [H, W, 3] counterclockwise, and crop it to the largest upright rectangle inside.

    Quarter turns are exact. Other angles are interpolated (cubic splines) and clamped to 0..1.
    """
    quarters, rest = divmod(degrees, 90)
    style = torch.rot90(style, int(quarters) % 4, (0, 1)).contiguous()
    if not rest:
        return style
    height, width = style.shape[:2]
    spun = scipy.ndimage.rotate(style.double().numpy(), rest, axes=(1, 0), reshape=True, order=3, mode="nearest")
    inner_height, inner_width = _inside(height, width, math.radians(rest))
    top, left = (spun.shape[0] - inner_height) // 2, (spun.shape[1] - inner_width) // 2
    cropped = spun[top : top + inner_height, left : left + inner_width]
    return torch.from_numpy(cropped).clamp(0, 1).to(style.dtype).contiguous()


def _inside(height: int, width: int, angle: float) -> tuple[int, int]:
    """Return the sides of the largest upright rectangle inside one that is rotated by 0 to pi/2; at least 1.

    If the rotated rectangle is narrow, two corners of the result lie on one of its long sides, and half of its short
    side is the limit. Otherwise, each corner of the result lies on a different side.
    """
    sine, cosine = math.sin(angle), math.cos(angle)
    shorter, longer = min(height, width), max(height, width)
    if shorter <= 2 * sine * cosine * longer:
        half = shorter / 2
        across, down = (half / sine, half / cosine) if width >= height else (half / cosine, half / sine)
    else:
        spread = cosine * cosine - sine * sine
        across, down = (width * cosine - height * sine) / spread, (height * cosine - width * sine) / spread
    # One pixel less on each side, where the interpolation reads beyond the image.
    return max(int(down) - 2, 1), max(int(across) - 2, 1)


@dataclass(frozen=True)
class StylizationJob:
    """Context of a stylization, which steps only read; `prepare_job` creates it.

    Attributes:
        scene: Scene with the SH attenuation of the settings applied.
        sh_degree: SH degree of the scene before the attenuation.
        graphs: Replacement for `loss` in steps; None if the plan uses no graphs.
        view_targets: Targets of the views, except the style's.
        memory_limit: Memory budget in bytes of all ranks on one machine together. It determines the partition, and
            thereby rounding, so it is identical on all ranks.
        survey_seconds: Seconds of the rasterizer's pass over a view, mean; 0 if unknown.
    """

    plan: Plan
    settings: Settings
    scene: Scene
    sh_degree: int
    styles: JobStyles
    weights: BackboneWeights
    network: FeatureNetwork
    loss: SosLoss
    graphs: LossGraphs | None
    views: Views
    view_targets: ViewTargets
    team: Team
    memory_limit: int
    memory: int
    style_targets: Callable[[Camera], StyleTargets]
    survey_seconds: float = 0.0

    @property
    def style(self) -> Style:
        """Style of all Gaussians that are not in a region with its own style."""
        return self.styles.own

    @property
    def regions(self) -> Regions | None:
        """Regions with their own style, or frozen; None for one style everywhere."""
        return self.styles.regions

    @property
    def collectives(self) -> Collectives:
        """All ranks that take part."""
        return self.team.everybody

    @property
    def group(self) -> Collectives:
        """Ranks that process the same views as this one."""
        return self.team.group

    @property
    def timer(self) -> Timer:
        """Timer of the activities of a step."""
        return self.loss.timer

    @property
    def schedule(self) -> list[Phase]:
        """The two phases of every preset."""
        return [Phase("coarse", self.plan.steps_coarse, 0), Phase("sos", self.settings.steps_sos)]

    @property
    def total_steps(self) -> int:
        """Number of steps of all phases."""
        return sum(phase.steps for phase in self.schedule)

    @property
    def round_length(self) -> int:
        """Number of steps in which every view is visited once."""
        return math.ceil(len(self.views.covered) / self.settings.views_per_step)

    @property
    def evaluation_views(self) -> list[int]:
        """Indices of the plan's `loss_views`, evenly spread over the views that see anything.

        The contact sheet shows the same views.
        """
        return spread(self.views.covered, self.plan.loss_views)

    @property
    def transfers_last(self) -> bool:
        """Whether the style's colors are transferred to results once more: see `ends_with_transfer`."""
        return ends_with_transfer(self.settings, warm=self.plan.warm_start)

    @property
    def preserves_chroma(self) -> bool:
        """Whether only luminance changes."""
        return self.settings.preserve_colors == "luminance"

    @property
    def caches(self) -> dict[str, Cache[Any, Any]]:
        """Caches of data of the views by name, "weights" before "intersections"."""
        return {**self.views.caches, **self.view_targets.caches}

    def gradient(
        self,
        index: int,
        sh_dc: Tensor,
        style: StyleTargets,
        target: ViewTarget,
        scales: Sequence[int] | Mapping[int, float],
        background: Color | None = None,
    ) -> tuple[Tensor, SosResult]:
        """Return dE/dsh_dc [n, 3] of one view for colors [n, 3], and the loss.

        Args:
            sh_dc: Colors of the rendered Gaussians.
            scales: Scales to evaluate; a mapping gives their weights (`SosLoss.evaluate`).
            background: Background color; None for that of the settings.
        """
        with self.timer("render"), torch.no_grad():
            colors = self.views.colors(index, sh_dc)
            image = self.views.render(index, colors)
            if background is not None:
                image = self.view_targets.replace_background(index, image, background)
        with self.timer("loss"):
            evaluate = self.graphs.evaluate if self.graphs is not None else self.loss.evaluate
            result = evaluate(image, style, target, scales)
        with self.timer("raster_backward"):
            assert result.image_gradient is not None
            return self.views.gradient(index, result.image_gradient.to(colors.device), colors), result

    def scales(self, index: int) -> list[int]:
        """Return the scales of a view with a positive weight, finest first."""
        camera = self.views.cameras[index]
        return self.loss.tiling.scales((camera.height, camera.width))


def prepare_job(
    plan: Plan,
    inputs: JobInputs,
    *,
    collectives: Collectives = ALONE,
    planning_context: PlanningContext | None = None,
) -> StylizationJob:
    """Prepare a planned job. Every rank calls this with the same arguments.

    Args:
        plan: Plan for these inputs, such as that of an earlier run of the same job.
        planning_context: Planning context of the plan; None to create its objects again.
    """
    scene, settings = inputs.scene, inputs.settings
    weights = weights_for(inputs.weights, settings)
    attenuated = planning_context.scene if planning_context else scene.attenuated(settings.sh_attenuation)
    fitted = fit_cameras(inputs.cameras, settings)
    blend_weights = plan.survey.total_blend_weights
    regions = inputs.regions and inputs.regions.resolved(blend_weights)
    styles = JobStyles.prepared(inputs.style, regions, settings, scene.sh_dc, blend_weights)
    forget_device_peak(plan.device)
    network = (
        planning_context.network(plan.precision)
        if planning_context
        else make_network(weights, settings, plan.precision, plan.device)
    )
    team = Team(settings, collectives)
    memory_limit = settings.memory_limit or plan.memory_limit
    memory = memory_limit // sharing_memory(team.everybody, plan.device)
    loss = make_loss(
        network,
        settings,
        memory_for("activations", memory),
        content_weight=styles.content_weight,
        timer=Timer(plan.device),
        collectives=team.group,
    )
    rendered = attenuated if plan.seen.all() else attenuated.subset(plan.seen)
    rendered = rendered.without_zero_bands()
    rasterizer = _make_rasterizer(plan, settings, rendered, memory, planning_context)
    if team.group.size > 1:  # the survey's tile intersections are those of whole views
        rasterizer.forget_views()
    views = Views(
        rendered,
        fitted,
        rasterizer,
        covered=list(plan.covered),
        memory=view_memory(plan, memory),
        clamp_aware_gradient=settings.clamp_aware_gradient,
        regions=plan.survey.regions if plan.weighted else None,
        divider=loss.divider,
        timer=loss.timer,
    )
    if plan.spare:
        views.caches["intersections"].limit(memory_for("rasterizer", memory) + plan.spare // 2)
    repeatable = rasterizer.repeatable
    view_targets = ViewTargets(
        views,
        loss,
        weighted=plan.weighted,
        photos=inputs.photos,
        memory=view_memory(plan, memory),
        regions=plan.survey.regions if plan.weighted else None,
        background=settings.background,
        drawn=plan.training_background != "background",
        maps=styles.maps(repeatable, plan.seen),
        content_maps=styles.content_maps(repeatable, plan.seen),
    )
    return StylizationJob(
        plan=plan,
        settings=settings,
        scene=attenuated,
        sh_degree=scene.sh_degree,
        styles=styles,
        weights=weights,
        network=network,
        loss=loss,
        graphs=LossGraphs(loss) if plan.graphs and team.group.size == 1 else None,
        views=views,
        view_targets=view_targets,
        team=team,
        memory_limit=memory_limit,
        memory=memory,
        style_targets=styles.cached_targets(loss),
    )


def in_bfloat16(job: StylizationJob, step: int) -> StylizationJob:
    """Return a job whose network continues in bfloat16 from a step in which float16 has overflowed."""
    network = make_network(job.weights, job.settings, "bfloat16", job.plan.device)
    job.loss.use(network)
    job.view_targets.forget_division()
    if job.graphs is not None:
        job.graphs.clear()
    line = Decision("precision", f"features in bfloat16 from step {step} on", "float16 has overflowed")
    plan = replace(job.plan, precision="bfloat16", decisions=(*job.plan.decisions, line))
    return replace(job, network=network, plan=plan, style_targets=job.styles.cached_targets(job.loss))


def _make_rasterizer(
    plan: Plan, settings: Settings, rendered: Scene, memory: int, planning_context: PlanningContext | None
) -> Rasterizer:
    """Return the plan's rasterizer of the rendered Gaussians."""
    budget = memory_for("rasterizer", memory)
    if planning_context and plan.seen.all():
        uncached = planning_context.rasterizer
    else:
        uncached = make_rasterizer(
            plan.uncached, rendered, background=settings.background, near=settings.near, memory=budget
        )
    if plan.cached_weights == "none":
        return uncached
    return CachedRasterizer(
        rendered,
        max_bytes=budget,
        min_intersection_bytes=memory_for("intersections", memory),
        precision="half" if plan.cached_weights == "half" else "float32",
        at_first_use=False,
        uncached=uncached,
    )


def view_memory(plan: Plan, memory: int) -> int:
    """Return the budget in bytes for data of the views: what other caches leave of it, and half of `Plan.spare`."""
    left = memory_for("views", memory) + plan.spare // 2
    if plan.cached_weights != "none":
        left -= memory_for("intersections", memory)
    if plan.measured:
        left -= (2 if plan.is_approximated else 1) * memory_for("measuring", memory)
    return left


def with_second_attempt(job: StylizationJob, work: Callable[[], T]) -> T:
    """Return the result of a function, which is called again if the GPU runs out of memory.

    Before that, caches are cleared, and the memory budget for activations is halved for the rest of the job. Results
    then differ by rounding. Several ranks make no second attempt, because the others wait for messages of the first.

    Raises:
        DeviceMemoryError: If the memory is still not enough.
    """
    try:
        return work()
    except torch.OutOfMemoryError:
        if job.collectives.size > 1:
            raise _not_enough(job, "") from None
    # Outside of the handler, because the exception refers to the tensors of the first attempt.
    job.loss.halve_memory(max(camera.height * camera.width for camera in job.views.cameras))
    job.view_targets.forget_division()
    if job.graphs is not None:
        job.graphs.clear()
    torch.cuda.empty_cache()
    try:
        return work()
    except torch.OutOfMemoryError:
        raise _not_enough(job, ", not even with half of the activations in memory") from None


def _not_enough(job: StylizationJob, attempt: str) -> DeviceMemoryError:
    free, total = torch.cuda.mem_get_info(job.network.device)
    return DeviceMemoryError(
        f"The GPU's memory ({total / 1e9:.1f} GB, {free / 1e9:.1f} GB free) is not enough for a step{attempt}. Stop "
        f"other programs on this GPU, or give a smaller --memory-limit than {job.memory_limit / 1e9:.1f} GB or a "
        "smaller --resolution (`max_resolution` in Python)."
    )
