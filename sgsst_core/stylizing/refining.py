"""Refinement: split large Gaussians before a job, without changing the unstylized image.

It surveys the views, determines from the gradient of the loss where finer Gaussians are needed, splits Gaussians, and
verifies the images. Nothing is stylized yet. The gradient is computed once per view, after the colors have been given
the style's mean and covariance in closed form. The first steps would reach such colors anyway, so the remaining
gradient shows where texture is needed.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.budget import memory_for
from sgsst_core.constants import SH_C0
from sgsst_core.features.vgg import weights_for
from sgsst_core.loss.sos import make_loss
from sgsst_core.loss.terms import ViewTarget
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.planning.plan import PlanningContext, equip
from sgsst_core.planning.survey import ShowPlanning, progress_of, psnr, survey_views
from sgsst_core.progress import Progress
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.refine import (
    MIN_PSNR,
    Footprints,
    Refinement,
    can_be_split,
    candidates,
    choose_pieces,
    finest_size,
    max_children,
    parents_of,
    piece_counts,
    split,
)
from sgsst_core.scene.camera import Camera, fit_cameras, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs
from sgsst_core.stylizing.styles import JobStyles, prepared_style, with_moments

#: Number of evenly spread views whose gradient is computed; each costs an iteration.
GRADIENT_VIEWS = 24
#: Number of views whose images are compared.
MEASURED_VIEWS = 6
#: Steps for fitting the colors of split Gaussians to the unstylized image.
_FITTING_STEPS = 5
#: Splits are undone in rounds until the images are close enough: maximum number of rounds, and fraction of the error
#: that the splits undone in a round account for.
_ROUNDS, _TAKEN_BACK = 24, 0.25


def refine(
    inputs: JobInputs, *, collectives: Collectives = ALONE, show: ShowPlanning | None = None
) -> Refinement | None:
    """Decide which Gaussians to split, and into how many. All ranks must call this, and get the same result.

    Args:
        inputs: Inputs of a job; frozen Gaussians of its regions are not split.
        show: Callback, called before each view that is surveyed, before each view whose gradient is computed, and
            before images are compared.

    Returns:
        The refinement; None if `settings.refine` turns it off.
    """
    settings = inputs.chosen.applied(inputs.settings) if inputs.chosen else inputs.settings
    if settings.growth <= 1:
        return None
    fitted, weights = fit_cameras(inputs.cameras, settings), weights_for(inputs.weights, settings)
    context = equip(inputs.scene, fitted, settings, weights, collectives, inputs.rasterizer)
    frozen = None if inputs.regions is None else inputs.regions.frozen
    return _Refining(context, inputs.style, collectives, frozen, show).run()


@dataclass(frozen=True)
class _Change:
    """Effect of splitting on the measured views.

    Attributes:
        psnr: PSNR in dB of all views together.
        lowest: PSNR in dB of the worst view.
        sh_dc: [M, 3], fitted colors of the split scene.
        squared: [N] float64, squared change of the pixels that each Gaussian contributes to, weighted by blend weights.
    """

    psnr: float
    lowest: float
    sh_dc: Tensor
    squared: Tensor


class _Refining:
    """Refinement of one scene.

    Args:
        style: Style of the job as given; styles of regions are not considered.
        frozen: [N] bool, frozen Gaussians, which are not split; None for none.
    """

    def __init__(
        self,
        planning_context: PlanningContext,
        style: Style,
        collectives: Collectives,
        frozen: Tensor | None,
        show: ShowPlanning | None,
    ) -> None:
        self._frozen, self._show = frozen, show
        self._planning_context, self._given, self._collectives = planning_context, style, collectives
        self._scene, self._settings = planning_context.scene, planning_context.settings
        self._rasterizer = planning_context.rasterizer
        self._footprints = Footprints(self._scene)

    def run(self) -> Refinement:
        """Run the refinement."""
        covered = self._survey()
        count = len(self._scene)
        nothing = Refinement(torch.ones((count, 3), dtype=torch.uint8), 0, count)
        lengths, finest = self._footprints.lengths, finest_size(self._settings)
        if not self._collectives.broadcast(lambda: bool((lengths > finest).any())):
            return nothing
        views = spread(covered, GRADIENT_VIEWS)
        cancels, magnitude = self._gradient_disagreement(views)
        sane = can_be_split(self._scene)
        sane = sane if self._frozen is None else sane & ~self._frozen
        allowed = candidates(self._footprints, sane, cancels, magnitude)
        budget, most = math.floor(self._settings.growth * count), max_children(self._footprints.weights)
        pieces, size = self._collectives.broadcast(
            lambda: choose_pieces(lengths, allowed, cancels, most, budget, finest)
        )
        chosen = int((piece_counts(pieces) > 1).sum())
        if self._show:
            self._show(Progress(stage="refining"))
        pieces, change = self._undo_until_images_are_preserved(pieces, views, spread(covered, MEASURED_VIEWS))
        counts = piece_counts(pieces)
        parents = int((counts > 1).sum())
        if change is None:
            return replace(nothing, reverted=chosen)
        return Refinement(
            pieces, parents, int(counts.sum()), size, change.psnr, change.lowest, chosen - parents, change.sh_dc
        )

    def _undo_until_images_are_preserved(
        self, pieces: Tensor, fitted: Sequence[int], views: Sequence[int]
    ) -> tuple[Tensor, _Change | None]:
        """Undo splits until the images of `views` are preserved. Return the remaining pieces, and the remaining change.

        Colors of split Gaussians are first fitted to the views `fitted`. The change is None if no Gaussian remains
        split.
        """
        for _ in range(_ROUNDS):
            if not bool((pieces > 1).any()):
                break
            change = self._change(pieces, fitted, views)
            if change.lowest >= MIN_PSNR:
                return pieces, change
            pieces = self._collectives.broadcast(functools.partial(self._undo_the_worst, pieces, change))
        return torch.ones_like(pieces), None

    def _survey(self) -> list[int]:
        """Survey every view, and return those that see anything."""
        collectives, context, visit = self._collectives, self._planning_context, self._footprints.add
        survey = survey_views(self._scene, context.cameras, self._rasterizer, collectives, self._show, visit)
        self._footprints.sums = self._sum(self._footprints.sums)
        self._footprints.reach = torch.stack(collectives.all_gather(self._footprints.reach)).amax(dim=0)
        return survey.covered

    def _gradient_disagreement(self, views: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return the sum over some views of the `disagreement` of the style loss gradient."""
        settings, total = self._settings, self._footprints.weights
        network = self._planning_context.network()
        style = prepared_style(self._given, settings, self._scene.sh_dc, total)
        scene = replace(self._scene, sh_dc=with_moments(self._scene.sh_dc, total, style))
        loss = make_loss(
            network,
            settings.model_copy(update={"content_weight": 0.0}),
            memory_for("activations", self._planning_context.machine.memory),
        )
        targets = JobStyles(style).cached_targets(loss)
        sums = torch.zeros((len(scene), 2), dtype=torch.float64)
        for done, (_, camera) in enumerate(self._of_this_rank(views)):
            if self._show:
                self._show(progress_of(done, len(views), self._collectives.size, "refining"))
            image = render(scene, self._rasterizer, camera)
            weighted = settings.position_weights != "off"
            weights = loss.targets.position_weights(self._rasterizer.coverage(camera)) if weighted else None
            gradient = loss.evaluate(image, targets(camera), ViewTarget(coverage=weights)).image_gradient
            assert gradient is not None
            gradient = gradient.to(self._rasterizer.device, self._rasterizer.dtype)
            sums += torch.stack(disagreement(self._rasterizer, camera, gradient), dim=1)
        cancels, magnitude = self._sum(sums).unbind(1)
        return cancels, magnitude

    def _change(self, pieces: Tensor, fitted: Sequence[int], views: Sequence[int]) -> _Change:
        """Return the effect of pieces [N, 3] on the unstylized image of `views`, with colors fitted to `fitted`."""
        scene = split(self._scene, pieces)
        rasterizer = self._rasterizer.for_scene(scene)
        scene = self._fit(scene, rasterizer, (piece_counts(pieces) > 1)[parents_of(pieces)], fitted)
        squared = torch.zeros(len(self._scene), dtype=torch.float64)
        errors: dict[int, float] = {}
        for index, camera in self._of_this_rank(views):
            before = render(self._scene, self._rasterizer, camera).clamp(0, 1)
            change = (render(scene, rasterizer, camera).clamp(0, 1) - before).square()
            errors[index] = float(change.mean(dtype=torch.float64))
            squared += self._rasterizer.color_gradient(change, camera).double().sum(dim=1).cpu()
        every = [error for by_view in self._collectives.all_gather(errors) for error in by_view.values()]
        return _Change(psnr(sum(every) / len(every)), psnr(max(every)), scene.sh_dc, self._sum(squared))

    def _fit(self, scene: Scene, rasterizer: Rasterizer, children: Tensor, views: Sequence[int]) -> Scene:
        """Fit the colors of children [M] bool in a split scene so that views look as before.

        Images are linear in colors. Each step adds to every child the mean error of its pixels, weighted by blend
        weights (simultaneous iterative reconstruction, Gilbert 1972). This converges because the weights of a pixel add
        up to at most 1, and gives a child no color that its pixels do not need.
        """
        children = children.to(self._rasterizer.device)
        for _ in range(_FITTING_STEPS):
            lacks = torch.zeros((len(scene), 4), dtype=torch.float64, device=self._rasterizer.device)
            for _, camera in self._of_this_rank(views):
                missing = render(self._scene, self._rasterizer, camera) - render(scene, rasterizer, camera)
                lacks[:, :3] += rasterizer.color_gradient(missing, camera)
                lacks[:, 3] += rasterizer.survey(camera)[1]
            lacks = self._collectives.all_reduce(lacks)
            step = lacks[:, :3] / lacks[:, 3:].clamp_min(1.0) / SH_C0
            more = torch.where(children[:, None], step, 0.0).to("cpu", torch.float32)
            scene = replace(scene, sh_dc=scene.sh_dc + more)
        return scene

    def _undo_the_worst(self, pieces: Tensor, change: _Change) -> Tensor:
        """Undo the splits that change the images most, up to a fraction of the total change."""
        parents = (piece_counts(pieces) > 1).nonzero()[:, 0]
        density = change.squared[parents] / self._footprints.weights[parents].clamp_min(1.0)
        order = torch.argsort(density, descending=True, stable=True)
        summed = change.squared[parents][order].cumsum(0)
        worst = parents[order[: int((summed < _TAKEN_BACK * summed[-1]).sum()) + 1]]
        fewer = pieces.clone()
        fewer[worst] = 1
        return fewer

    def _of_this_rank(self, views: Sequence[int]) -> list[tuple[int, Camera]]:
        """Return the views that this rank processes, with their cameras."""
        own = views[self._collectives.rank :: self._collectives.size]
        return [(index, self._planning_context.cameras[index]) for index in own]

    def _sum(self, values: Tensor) -> Tensor:
        """Return the sum over all ranks."""
        return self._collectives.all_reduce(values.to(self._rasterizer.device)).cpu()


def disagreement(rasterizer: Rasterizer, camera: Camera, image_gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Return how much of an image gradient [H, W, 3] cancels under each Gaussian, and its total: both [N] float64.

    With gradients g and blend weights w, the total is sum |g| w over pixels and channels. Only |sum g w| of it remains
    in the gradient of the Gaussian's color. The rest cancels, because the Gaussian's pixels disagree. Computing this
    takes two passes of the rasterizer, for |g| and g. G-Style (Kovács, Hermosilla, Raidou 2024) also splits by gradient
    magnitudes, which it accumulates over steps.
    """
    total = rasterizer.color_gradient(image_gradient.abs(), camera).double()
    summed = rasterizer.color_gradient(image_gradient, camera).double().abs()
    return (total - summed).clamp_min(0).sum(dim=1).cpu(), total.sum(dim=1).cpu()


def render(scene: Scene, rasterizer: Rasterizer, camera: Camera) -> Tensor:
    """Return the image [H, W, 3] of a scene, using a rasterizer with its geometry."""
    return rasterizer.render(scene_colors(scene, camera, rasterizer.device), camera)
