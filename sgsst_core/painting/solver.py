"""Colors of the Gaussians that painted views show, by least squares.

Geometry is frozen, so the image of a view is linear in the colors: W c + T b, with the blend weights W, the final
transmittance T and the background b. Painted views v determine the DC colors x by

    min_x  sum_v || W_v max(0, x + rest_v) + T_v b - painted_v ||^2 + (x - base)^T D (x - base)

where rest_v are the view-dependent colors, which stay, and D = RELATIVE_RIDGE * S + RIDGE, with S the sum of each
Gaussian's blend weights. Where a picture is transparent, painted_v is the view as it was. The minimum is found by
conjugate gradients (Hestenes and Stiefel, "Methods of conjugate gradients for solving linear systems", 1952),
preconditioned with S + D: the blend weights of a pixel add up to at most 1, so S bounds the diagonal of W^T W and its
row sums. Each iteration is a render and a color gradient of each view. Channels that the clamp or the bounds of the
screen hold are an active set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import CameraError
from sgsst_core.painting.spreading import Spreading
from sgsst_core.rasterizer.base import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors

#: Resistance of a color to change: relative to its blend weights, and in pixels of blend weight. The first keeps colors
#: of Gaussians that overlap from drifting apart; the second keeps Gaussians that hardly count in the pixels.
RELATIVE_RIDGE, RIDGE = 0.01, 0.03
#: Iterations of the first solution, rounds of spreading and solving after it, iterations of each, and those of all.
ITERATIONS, ROUNDS, ROUND_ITERATIONS = 16, 3, 12
PASSES = ITERATIONS + ROUNDS * ROUND_ITERATIONS
#: Pixels of blend weight that halve the confidence in a Gaussian's color.
_LEAST_PIXELS = 0.1


@dataclass(frozen=True)
class PaintedView:
    """Picture of a view after somebody painted on it.

    Attributes:
        camera: Camera of the picture.
        image: [h, w, 3] float32, sRGB in 0..1.
        alpha: [h, w] float32 in 0..1, opacity of the paint; where it is 0, the view stays as it was.
    """

    camera: Camera
    image: Tensor
    alpha: Tensor


@dataclass(frozen=True)
class Solution:
    """Solution of a least squares problem.

    Attributes:
        colors: [N, 3] float32, DC colors.
        residual: Norm of the preconditioned gradient at the end, relative to that at the start.
    """

    colors: Tensor
    residual: float


class PaintedColors:
    """Least squares problem of painted views.

    Args:
        scene: Scene of the pictures.
        views: Painted views.
        rasterizer: Rasterizer of the scene, with the background of the pictures.

    Raises:
        CameraError: If the views show no Gaussian.

    Attributes:
        original: [N, 3] float32, DC colors of the scene.
        weights: [N] float64, blend weights of each Gaussian in all views, in pixels.
    """

    def __init__(self, scene: Scene, views: Sequence[PaintedView], rasterizer: Rasterizer) -> None:
        device, dtype = rasterizer.device, rasterizer.dtype
        surveys = [rasterizer.survey(view.camera)[1] for view in views]
        self.weights = torch.stack(surveys).double().sum(dim=0)
        self._shown = self.weights > 0
        if not bool(self._shown.any()):
            raise CameraError("The painted pixels show nothing of the scene. Paint on a view that does.")
        shown = scene.subset(self._shown.cpu())
        self._views, self._rasterizer = views, rasterizer.for_scene(shown)
        self._rest = [rest_colors(shown.sh_rest, shown.means, view.camera).to(device, dtype) for view in views]
        self._alphas = [view.alpha.to(device, dtype)[:, :, None] for view in views]
        self.original = COLOR_OFFSET + SH_C0 * scene.sh_dc.to(device, dtype)
        self._images = [
            torch.lerp(self._image(index, self.original[self._shown]), view.image.to(device, dtype), alpha)
            for index, (view, alpha) in enumerate(zip(views, self._alphas, strict=True))
        ]
        weights = self.weights[self._shown].to(dtype)[:, None]
        self._ridge = RELATIVE_RIDGE * weights + RIDGE
        self._metric = weights + self._ridge
        black = torch.zeros_like(self._ridge.expand(-1, 3))
        self._behind = [self._rasterizer.render(black, view.camera) for view in views]  # T b

    def _image(self, index: int, colors: Tensor) -> Tensor:
        """Return the image [h, w, 3] of a painted view for DC colors [n, 3] of the Gaussians that the views show."""
        return self._rasterizer.render((colors + self._rest[index]).clamp_min(0), self._views[index].camera)

    def psnr(self, colors: Tensor) -> float:
        """Return the peak signal-to-noise ratio in dB of DC colors [N, 3] on the painted pixels."""
        error = total = 0.0
        for index, (image, alpha) in enumerate(zip(self._images, self._alphas, strict=True)):
            wrong = self._image(index, colors[self._shown]).clamp(0, 1) - image
            error += float((wrong.double().square() * alpha).sum())
            total += 3 * float(alpha.double().sum())
        return float(-10 * torch.log10(torch.tensor(max(error / max(total, 1e-12), 1e-12))))

    def solve(
        self,
        base: Tensor,
        *,
        bounded: bool = True,
        iterations: int = ITERATIONS,
        show: Callable[[int], None] = lambda done: None,
    ) -> Solution:
        """Return the colors that minimize the error on the painted pixels and the distance to other colors.

        Args:
            base: [N, 3], DC colors of the first iteration, to which Gaussians return where the pictures say nothing.
            bounded: Whether colors stay within 0..1, or as far outside as they were.
            iterations: Maximum number of iterations.
            show: Callback that receives the number of completed iterations.
        """
        original, own = self.original[self._shown], base[self._shown]
        least, most = original.clamp_max(0), original.clamp_min(1)
        x = self._unclamped(own)
        error, passing = self._descent(x, own)
        free = torch.ones_like(x, dtype=torch.bool)
        if bounded:
            free = ~(((x <= least) & (error < 0)) | ((x >= most) & (error > 0)))
        residual = error * free
        change, scaled = torch.zeros_like(x), residual / self._metric
        direction, before = scaled, _dot(residual, scaled)
        first = before
        for done in range(iterations):
            show(done)
            if before <= 1e-12 * first:
                break
            image_of = self._curvature(direction, passing) * free
            length = before / _dot(direction, image_of)
            change, residual = change + length * direction, residual - length * image_of
            scaled = residual / self._metric
            after = _dot(residual, scaled)
            direction, before = scaled + after / before * direction, after
        x = x + change
        colors = base.clone()
        colors[self._shown] = torch.clamp(x, least, most) if bounded else x
        return Solution(colors, (before / first) ** 0.5 if first else 0.0)

    def _unclamped(self, x: Tensor) -> Tensor:
        """Raise clamped colors to the clamp of the views: the images stay, and they can rise."""
        return torch.maximum(x, -torch.stack(self._rest).amax(dim=0))

    def _descent(self, x: Tensor, base: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return half the negative gradient of the objective, and for each view which channels change its image."""
        descent, passing = -self._ridge * (x - base), []
        for index, view in enumerate(self._views):
            missing = self._images[index] - self._image(index, x)
            own = self._rasterizer.color_gradient(missing, view.camera)
            shown = x + self._rest[index]
            passing.append((shown > 0) | ((shown >= -1e-6) & (own > 0)))
            descent = descent + own * passing[-1]
        return descent, passing

    def _curvature(self, direction: Tensor, passing: Sequence[Tensor]) -> Tensor:
        """Return (sum of W^T W + D) times a change of colors."""
        result = self._ridge * direction
        for view, behind, passes in zip(self._views, self._behind, passing, strict=True):
            image = self._rasterizer.render(direction * passes, view.camera) - behind
            result = result + self._rasterizer.color_gradient(image, view.camera) * passes
        return result


def _show_from(first: int, show: Callable[[int], None], done: int) -> None:
    show(first + done)


def _dot(left: Tensor, right: Tensor) -> float:
    return float((left.double() * right.double()).sum())


@dataclass(frozen=True)
class Painted:
    """Colors of a scene that follows its painted views.

    Attributes:
        sh_dc: [N, 3] float32 on the CPU.
        psnr_before, psnr_after: Peak signal-to-noise ratio in dB on the painted pixels.
        residual: Norm of the preconditioned gradient at the end, relative to that at the start of the last solution.
        determined: Number of Gaussians with a confidence above a quarter.
    """

    sh_dc: Tensor
    psnr_before: float
    psnr_after: float
    residual: float
    determined: int


def paint(
    scene: Scene,
    views: Sequence[PaintedView],
    rasterizer: Rasterizer,
    *,
    others: Sequence[Camera] = (),
    show: Callable[[int], None] = lambda done: None,
) -> Painted:
    """Return the colors of a scene that looks like painted pictures of it, also where they do not show it.

    Least squares and spreading alternate: a color that the pictures hardly determine returns to what the others say.

    Args:
        rasterizer: Rasterizer of the scene, with the background of the pictures.
        others: Cameras of other views. A Gaussian that they show much better than the painted ones follows the others.
        show: Callback that receives the number of completed iterations, of at most `PASSES`. It may raise an error.

    Raises:
        InvalidInputError: If the pictures show no Gaussian.
    """
    problem = PaintedColors(scene, views, rasterizer)
    weights, original = problem.weights, problem.original
    most = weights.clone()
    for camera in others:
        torch.maximum(most, rasterizer.survey(camera)[1].double(), out=most)
    confidence = weights / (weights + most + _LEAST_PIXELS)
    spreading = Spreading(scene.means, original.cpu(), confidence.cpu())
    least, highest = original.clamp_max(0), original.clamp_min(1)
    solution = problem.solve(original, show=show)
    for first in range(ITERATIONS, PASSES, ROUND_ITERATIONS):
        change = spreading((solution.colors - original).cpu()).to(original)
        base = torch.clamp(original + change, least, highest)
        solution = problem.solve(base, iterations=ROUND_ITERATIONS, show=partial(_show_from, first, show))
    show(PASSES)
    sh_dc = ((solution.colors - COLOR_OFFSET) / SH_C0).cpu().to(torch.float32)
    sh_dc = torch.where(solution.colors.cpu() == original.cpu(), scene.sh_dc, sh_dc)
    determined = int((confidence > 0.25).sum())
    return Painted(sh_dc, problem.psnr(original), problem.psnr(solution.colors), solution.residual, determined)
