"""Colors of a scene that show what somebody painted on pictures of it.

Geometry is frozen, so the image of a view is linear in the colors: W c + T b, with the blend weights W, the final
transmittance T and the background b. Painted views v determine the DC colors x by

    min_x  sum_v || W_v max(0, x + rest_v) + T_v b - painted_v ||^2 + (x - base)^T D (x - base)

where rest_v are the view-dependent colors, which stay, and D = RELATIVE_RIDGE * S + RIDGE, with S the sum of each
Gaussian's blend weights. Where a picture is transparent, painted_v is the view as it was. The minimum is found by
conjugate gradients (Hestenes and Stiefel, "Methods of conjugate gradients for solving linear systems", 1952),
preconditioned with S + D: the blend weights of a pixel add up to at most 1, so S bounds the diagonal of W^T W and its
row sums. Each iteration is a render and a color gradient of each view. Channels that the clamp or the bounds of the
screen hold are an active set.

The change of Gaussians that painted views do not determine follows from the change of those that they do. Two parts add
up. A map of colors says how a color changes anywhere: an affine function of all colors, and one more for each of some
clusters of colors, blended smoothly. It carries night, or another hue of all blue things. What the neighbors in place
and color change beyond this map is local, such as a stroke: it is added, and fades with the distance to them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import CameraError
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
#: Clusters of colors, and the standard deviation in 0..1 over which their maps blend.
_CLUSTERS, _SOFTNESS = 16, 0.08
#: Resistance of a cluster's map to differing from that of all colors, relative to the confidence of its Gaussians, and
#: to that of so many more.
_RIDGE, _PRIOR = 0.01, 100.0
#: Neighbors of a Gaussian; distances in place are in `_PLACE` of the scene's extent, those in color in `_COLOR`.
_NEIGHBORS, _PLACE, _COLOR = 24, 0.2, 0.1
#: Size of a cell in these units, and how much farther than the nearest neighbors those that are used may be.
_CELL, _APPROXIMATION = 0.3, 2.0
#: Size of a cell of places alone, in the scene's extent.
_BLOCK = 0.01
#: Distance, in the scene's extent, of a number of known Gaussians over which the neighbors' own change fades.
_FADE, _NEAR = 0.1, 8
#: Confidence from which on a Gaussian is a neighbor, and the greatest number of such Gaussians, and of cells of one.
_LEAST, _MOST = 0.05, 200_000
#: Gaussians on which clusters are chosen, and rounds of k-means.
_SAMPLED, _ROUNDS = 20_000, 20
#: Gaussians processed at a time.
_CHUNK = 1 << 16


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
        shown: int = 0,
    ) -> tuple[Tensor, float]:
        """Return the colors that minimize the error on the painted pixels and the distance to other colors.

        Args:
            base: [N, 3], DC colors of the first iteration, to which Gaussians return where the pictures say nothing.
            bounded: Whether colors stay within 0..1, or as far outside as they were.
            iterations: Maximum number of iterations.
            show: Callback that receives the number of completed iterations, those of earlier solutions included.
            shown: Number of iterations of earlier solutions.

        Returns:
            DC colors [N, 3] float32, and the norm of the preconditioned gradient at the end relative to that at the
            start.
        """
        original, own = self.original[self._shown], base[self._shown]
        least, most = original.clamp_max(0), original.clamp_min(1)
        x = torch.maximum(own, -torch.stack(self._rest).amax(dim=0))  # clamped colors can rise, and the images stay
        error, passing = self._descent(x, own)
        free = torch.ones_like(x, dtype=torch.bool)
        if bounded:
            free = ~(((x <= least) & (error < 0)) | ((x >= most) & (error > 0)))
        residual = error * free
        change, scaled = torch.zeros_like(x), residual / self._metric
        direction, before = scaled, _dot(residual, scaled)
        first = before
        for done in range(iterations):
            show(shown + done)
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
        return colors, (before / first) ** 0.5 if first else 0.0

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


def _dot(left: Tensor, right: Tensor) -> float:
    return float((left.double() * right.double()).sum())


class Spreading:
    """Function from the change of known Gaussians to that of all, prepared once.

    In large scenes, what the neighbors add is computed once for all Gaussians in a cell of place and color, and its
    fading once for all in a cell of places.

    Args:
        means: [N, 3], places.
        colors: [N, 3], DC colors before the change.
        confidence: [N] in 0..1: how much the painted views determine a Gaussian's color.
    """

    def __init__(self, means: Tensor, colors: Tensor, confidence: Tensor) -> None:
        self._colors, confidence = colors.double().clamp(0, 1).cpu(), confidence.double().cpu()
        places = means.double().cpu()
        known = (confidence > min(_LEAST, 0.5 * float(confidence.max()))).nonzero()[:, 0]
        generator = torch.Generator().manual_seed(0)
        if len(known) > _MOST:
            known = known[torch.randperm(len(known), generator=generator)[:_MOST]].sort().values
        self._known, self._confidence = known, confidence[known]
        self._centers = _clusters(self._colors[known], self._confidence, generator)
        ordered = places[:: max(len(places) // 100_000, 1)]
        low, high = torch.quantile(ordered, torch.tensor([0.1, 0.9], dtype=torch.float64), dim=0)
        places = (places - low) / (float((high - low).norm()) or 1.0)
        features = torch.cat([places / _PLACE, self._colors / _COLOR], dim=1)
        self._cells, centers = _cells(features, _CELL)
        distance, self._nearest = _neighbors(features[known], centers, _NEIGHBORS)
        scale = distance[:, distance.shape[1] // 2, None].clamp_min(1e-9)
        votes = self._confidence[self._nearest] * torch.exp(-0.5 * (distance / scale).square())
        self._votes = votes / votes.sum(dim=1, keepdim=True).clamp_min(1e-300)
        blocks, centers = _cells(places, _BLOCK)
        away = _neighbors(places[known], centers, _NEAR)[0][blocks, -1:]
        self._fade = torch.exp(-(away / _FADE).square())

    def __call__(self, change: Tensor) -> Tensor:
        """Return the change [N, 3] of all Gaussians, given that of the known ones in rows of [N, 3]."""
        own = change.double().cpu()[self._known]
        maps = self._maps(own)
        beyond = own - self._mapped(self._colors[self._known], maps)
        blocks = zip(self._votes.split(_CHUNK), self._nearest.split(_CHUNK), strict=True)
        local = torch.cat([(votes[:, :, None] * beyond[nearest]).sum(dim=1) for votes, nearest in blocks])
        mapped = torch.cat([self._mapped(colors, maps) for colors in self._colors.split(_CHUNK)])
        return (mapped + self._fade * local[self._cells]).to(change)

    def _maps(self, change: Tensor) -> Tensor:
        """Return affine maps of color [1 + K, 4, 3], of all known Gaussians and of each cluster, that fit a change."""
        colors, weight = self._colors[self._known], self._confidence[:, None]
        everywhere = _fitted(colors, weight, change, (colors * weight).sum(dim=0) / weight.sum(), 1e-6)
        remaining, members = change - _terms(colors) @ everywhere, weight * _memberships(colors, self._centers)
        clusters = enumerate(self._centers)
        maps = [_fitted(colors, members[:, index, None], remaining, center, _RIDGE) for index, center in clusters]
        return torch.stack([everywhere, *maps])

    def _mapped(self, colors: Tensor, maps: Tensor) -> Tensor:
        """Return the change [n, 3] of colors by the maps."""
        blend = torch.cat([torch.ones_like(colors[:, :1]), _memberships(colors, self._centers)], dim=1)
        own = (blend @ maps.flatten(1)).view(-1, 4, 3)
        return (_terms(colors)[:, :, None] * own).sum(dim=1)


def _terms(colors: Tensor) -> Tensor:
    return torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)


def _fitted(colors: Tensor, weight: Tensor, change: Tensor, center: Tensor, ridge: float) -> Tensor:
    """Return the affine map of color [4, 3] that fits a change best, and hardly depends on color away from a center."""
    terms = _terms(colors - center)
    resist = ridge * (float(weight.sum()) + _PRIOR) * torch.eye(4, dtype=torch.float64)
    resist[3, 3] = ridge * _PRIOR
    map: Tensor = torch.linalg.solve((terms * weight).T @ terms + resist, (terms * weight).T @ change)
    map[3] -= center @ map[:3]
    return map


def _cells(features: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return the cell of each row [N], and the mean row of each cell [M, d], given rows of up to six values.

    Up to `_MOST` rows have a cell each.
    """
    if len(features) <= _MOST:
        return torch.arange(len(features)), features
    steps = (features / size).floor().clamp(-512, 511).long() + 512
    keys = (steps * 1024 ** torch.arange(features.shape[1])).sum(dim=1)
    _, cells, counts = torch.unique(keys, return_inverse=True, return_counts=True)
    sums = torch.zeros(len(counts), features.shape[1], dtype=features.dtype).index_add_(0, cells, features)
    return cells, sums / counts[:, None]


def _neighbors(known: Tensor, rows: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return distances and indices [M, k] of the nearest known rows, each at most 1 + `_APPROXIMATION` as far."""
    count = min(count, len(known))
    tree = cKDTree(known.numpy())
    results = tree.query(rows.numpy(), k=count, eps=_APPROXIMATION, workers=torch.get_num_threads())
    distance, nearest = (torch.as_tensor(each).reshape(-1, count) for each in results)
    return distance, nearest


def _memberships(colors: Tensor, centers: Tensor) -> Tensor:
    """Return how much each color [N, 3] belongs to each cluster, [N, K] with rows that add up to 1."""
    return torch.softmax(-torch.cdist(colors, centers).square() / (2 * _SOFTNESS**2), dim=1)


def _clusters(colors: Tensor, weights: Tensor, generator: torch.Generator) -> Tensor:
    """Return centers [K, 3] of weighted colors by k-means, seeded by k-means++ (Arthur and Vassilvitskii, 2007)."""
    rows = torch.randperm(len(colors), generator=generator)[:_SAMPLED]
    colors, weights = colors[rows], weights[rows]
    centers = colors[torch.multinomial(weights, 1, generator=generator)]
    while len(centers) < min(_CLUSTERS, len(colors)):
        away = torch.cdist(colors, centers).amin(dim=1).square()
        centers = torch.cat([centers, colors[torch.multinomial(weights * away + 1e-12, 1, generator=generator)]])
    for _ in range(_ROUNDS):
        own = torch.cdist(colors, centers).argmin(dim=1)
        total = torch.zeros(len(centers), dtype=colors.dtype).index_add_(0, own, weights)
        sums = torch.zeros_like(centers).index_add_(0, own, colors * weights[:, None])
        centers = torch.where(total[:, None] > 0, sums / total[:, None].clamp_min(1e-300), centers)
    return centers


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
    colors, residual = problem.solve(original, show=show)
    for first in range(ITERATIONS, PASSES, ROUND_ITERATIONS):
        change = spreading((colors - original).cpu()).to(original)
        base = torch.clamp(original + change, least, highest)
        colors, residual = problem.solve(base, iterations=ROUND_ITERATIONS, show=show, shown=first)
    show(PASSES)
    sh_dc = ((colors - COLOR_OFFSET) / SH_C0).cpu().to(torch.float32)
    sh_dc = torch.where(colors.cpu() == original.cpu(), scene.sh_dc, sh_dc)
    determined = int((confidence > 0.25).sum())
    return Painted(sh_dc, problem.psnr(original), problem.psnr(colors), residual, determined)
