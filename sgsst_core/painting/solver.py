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
#: Iterations of a solution, and rounds of spreading and solving after the first solution.
ITERATIONS, ROUNDS = 16, 3
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

    Attributes:
        original: [N, 3] float32, DC colors of the scene.
        weights: [N] float64, blend weights of each Gaussian in all views, in pixels.
    """

    def __init__(self, scene: Scene, views: Sequence[PaintedView], rasterizer: Rasterizer) -> None:
        self._views, self._rasterizer = views, rasterizer
        device, dtype = rasterizer.device, rasterizer.dtype
        self._rest = [rest_colors(scene.sh_rest, scene.means, view.camera).to(device, dtype) for view in views]
        self._alphas = [view.alpha.to(device, dtype)[:, :, None] for view in views]
        self.original = COLOR_OFFSET + SH_C0 * scene.sh_dc.to(device, dtype)
        self._images = [
            torch.lerp(self.image(index, self.original), view.image.to(device, dtype), self._alphas[index])
            for index, view in enumerate(views)
        ]
        surveys = [rasterizer.survey(view.camera)[1] for view in views]
        self.weights = torch.stack(surveys).double().sum(dim=0)
        self._ridge = (RELATIVE_RIDGE * self.weights + RIDGE).to(dtype)[:, None]
        self._metric = self.weights.to(dtype)[:, None] + self._ridge
        black = torch.zeros_like(self.original)
        self._behind = [rasterizer.render(black, view.camera) for view in views]  # T b

    def image(self, index: int, colors: Tensor) -> Tensor:
        """Return the image [h, w, 3] of a painted view for DC colors [N, 3]."""
        return self._rasterizer.render((colors + self._rest[index]).clamp_min(0), self._views[index].camera)

    def psnr(self, colors: Tensor) -> float:
        """Return the peak signal-to-noise ratio in dB of DC colors [N, 3] on the painted pixels."""
        error = total = 0.0
        for index, (image, alpha) in enumerate(zip(self._images, self._alphas, strict=True)):
            wrong = self.image(index, colors).clamp(0, 1) - image
            error += float((wrong.double().square() * alpha).sum())
            total += 3 * float(alpha.double().sum())
        return float(-10 * torch.log10(torch.tensor(max(error / max(total, 1e-12), 1e-12))))

    def solve(self, base: Tensor, start: Tensor | None = None, *, bounded: bool = True) -> Solution:
        """Return the colors that minimize the error on the painted pixels and the distance to other colors.

        Args:
            base: [N, 3], DC colors that Gaussians return to where the pictures say nothing.
            start: [N, 3], colors of the first iteration; None for `base`.
            bounded: Whether colors stay within 0..1, or as far outside as they were.
        """
        least, most = self.original.clamp_max(0), self.original.clamp_min(1)
        x = self._unclamped(base if start is None else start)
        error, passing = self._descent(x, base)
        free = torch.ones_like(x, dtype=torch.bool)
        if bounded:
            free = ~(((x <= least) & (error < 0)) | ((x >= most) & (error > 0)))
        residual = error * free
        change, scaled = torch.zeros_like(x), residual / self._metric
        direction, before = scaled, _dot(residual, scaled)
        first = before
        for _ in range(ITERATIONS):
            if before <= 1e-12 * first:
                break
            image_of = self._curvature(direction, passing) * free
            length = before / _dot(direction, image_of)
            change, residual = change + length * direction, residual - length * image_of
            scaled = residual / self._metric
            after = _dot(residual, scaled)
            direction, before = scaled + after / before * direction, after
        x = x + change
        return Solution(torch.clamp(x, least, most) if bounded else x, (before / first) ** 0.5 if first else 0.0)

    def _unclamped(self, x: Tensor) -> Tensor:
        """Raise clamped colors of painted Gaussians to the clamp of the views: the images stay, and they can rise."""
        highest = torch.stack(self._rest).amax(dim=0)
        return torch.where(self.weights[:, None] > 0, torch.maximum(x, -highest), x)

    def _descent(self, x: Tensor, base: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Return half the negative gradient of the objective, and for each view which channels change its image."""
        descent, passing = -self._ridge * (x - base), []
        for index, view in enumerate(self._views):
            missing = self._images[index] - self.image(index, x)
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
    show: Callable[[int, int], None] = lambda done, total: None,
) -> Painted:
    """Return the colors of a scene that looks like painted pictures of it, also where they do not show it.

    Least squares and spreading alternate: a color that the pictures hardly determine returns to what the others say.

    Args:
        rasterizer: Rasterizer of the scene, with the background of the pictures.
        others: Cameras of other views. A Gaussian that they show much better than the painted ones follows the others.
        show: Callback that receives the number of completed and of all solutions.

    Raises:
        InvalidInputError: If the pictures show no Gaussian.
    """
    problem = PaintedColors(scene, views, rasterizer)
    weights, original = problem.weights, problem.original
    if not bool((weights > 0).any()):
        raise CameraError("The painted pixels show nothing of the scene. Paint on a view that does.")
    most = weights.clone()
    for camera in others:
        torch.maximum(most, rasterizer.survey(camera)[1].double(), out=most)
    confidence = weights / (weights + most + _LEAST_PIXELS)
    spreading = Spreading(scene.means, original.cpu(), confidence.cpu())
    least, highest = original.clamp_max(0), original.clamp_min(1)
    solution = problem.solve(original)
    for done in range(ROUNDS):
        show(done + 1, ROUNDS + 1)
        change = spreading((solution.colors - original).cpu()).to(original)
        solution = problem.solve(torch.clamp(original + change, least, highest))
    show(ROUNDS + 1, ROUNDS + 1)
    sh_dc = ((solution.colors - COLOR_OFFSET) / SH_C0).cpu().to(torch.float32)
    sh_dc = torch.where(solution.colors.cpu() == original.cpu(), scene.sh_dc, sh_dc)
    determined = int((confidence > 0.25).sum())
    return Painted(sh_dc, problem.psnr(original), problem.psnr(solution.colors), solution.residual, determined)
