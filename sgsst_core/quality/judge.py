"""Independent judgment of a stylized scene, using features that no job optimizes.

A job's own loss cannot show whether its result is good, because the job minimizes this loss. No job optimizes the
features of AlexNet (the network of LPIPS). Their Gram matrices measure how close textures are to the style; their
change measures the loss of content. Color statistics measure how close colors are to the style. Only pixels covered by
Gaussians count. Every view is judged on a black and on a white background, because the background of an object scan is
arbitrary.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.quality.consistency import shown
from sgsst_core.quality.lpips import Lpips, unit_features
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import resize_area, style_size
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from sgsst_core.style import Style
from sgsst_core.stylizing.color_moments import Moments, color_moments, square_root, style_moments
from sgsst_core.stylizing.job_styles import JobStyles

#: Maximum longer side of judged views in pixels. The limit keeps results at different resolutions comparable, and
#: bounds the cost of large views.
JUDGED_SIDE = 1024
#: Gray values of the backgrounds that each view is judged on: black and white.
_BEHIND = (0.0, 1.0)
#: Minimum coverage of judged views.
_LEAST_COVERAGE = 1e-3
#: Factor that converts color distances to 8-bit levels.
_LEVELS = 255.0


@dataclass(frozen=True)
class Judgment:
    """Judgment of a scene's colors, averaged over views and over a black and a white background.

    Attributes:
        style: Relative distance |G - G_style| / |G_style| (Frobenius norm) of Gram matrices, averaged over AlexNet's
            five layers. G is the mean of F F^T over positions. 0 for the style's own texture.
        color_distance: Frechet distance of the RGB colors in 8-bit levels: sqrt(|m - m_style|^2 + tr(C + C_style - 2 (C
            C_style)^1/2)); 0 if mean and covariance equal the style's.
        content: LPIPS (AlexNet) against the unstylized scene; 0 for identical images.
        features: 1 - cosine between AlexNet's features of the stylized and the unstylized scene, averaged over layers.
        background_sensitivity: Absolute difference in `style` between black and white background, averaged over views.
        saturated: Fraction of the Gaussians with a color channel outside [0, 1].
    """

    style: float
    color_distance: float
    content: float
    features: float
    background_sensitivity: float
    saturated: float


class Judge:
    """Judge that compares colors of one scene with one style.

    Args:
        lpips: LPIPS with AlexNet.
        style: Style image [H, W, 3] in 0 to 1; or a weighted mixture of images, whose Gram matrices and color
            statistics are averaged; or the styles of the scene's regions. For regions, `Judgment.style` and
            `Judgment.color_distance` are averaged over regions, weighted by their fraction of a view, and frozen
            regions are ignored.
        scene: Unstylized scene.
        rasterizer: Rasterizer of the scene.
        cameras: Cameras of the views. Views larger than `JUDGED_SIDE` are judged at that size. Views that see almost
            nothing, or are too small for AlexNet (a side below 31 pixels), are skipped.
        background: Background color [3] of the rasterizer.

    Attributes:
        cameras: Cameras of the judged views; if empty, there is no judgment.
    """

    def __init__(
        self,
        lpips: Lpips,
        style: Tensor | Style | JobStyles,
        scene: Scene,
        rasterizer: Rasterizer,
        cameras: Sequence[Camera],
        background: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.scene = scene
        self._lpips, self._rasterizer = lpips, rasterizer
        styles = style if isinstance(style, JobStyles) else JobStyles(Style.of(style))
        self._judges = [_StyleJudge(lpips, each) for each in styles.each or (styles.own,)]
        self._maps = styles.maps(rasterizer)
        self._background = torch.tensor(background, dtype=rasterizer.dtype, device=rasterizer.device)
        self._sh_rest, self._means = scene.sh_rest.to(rasterizer.device), scene.means.to(rasterizer.device)
        small = [resized(camera, min(JUDGED_SIDE, camera.side)) for camera in cameras]
        self.cameras = [
            camera
            for camera in small
            if min(camera.width, camera.height) >= lpips.minimum_side and self._covered(camera) >= _LEAST_COVERAGE
        ]

    @torch.no_grad()
    def judge(self, sh_dc: Tensor) -> Judgment | None:
        """Judge colors `sh_dc` [N, 3]; return None if there are no views to judge.

        Raises:
            ValueError: If an image contains NaN or infinity.
        """
        if not self.cameras:
            return None
        sh_dc = sh_dc.detach().to(self._rasterizer.device)
        views = [self._view(camera, sh_dc) for camera in self.cameras]
        style, color_distance, content, features = (
            fmean(fmean(one[index] for one in view) for view in views) for index in range(4)
        )
        background_sensitivity = fmean(abs(view[0][0] - view[1][0]) for view in views)
        return Judgment(style, color_distance, content, features, background_sensitivity, saturated(sh_dc))

    @torch.no_grad()
    def renders(self, sh_dc: Tensor, camera: Camera) -> list[Tensor]:
        """Render colors `sh_dc` [N, 3] on black and on white, as images [H, W, 3]."""
        image, coverage = self._render(sh_dc.detach().to(self._rasterizer.device), camera)
        return [self._on(image, coverage, camera, behind) for behind in _BEHIND]

    def _view(self, camera: Camera, sh_dc: Tensor) -> list[tuple[float, float, float, float]]:
        """Return (style, color_distance, content, features) of a view, on black and on white background."""
        image, coverage = self._render(sh_dc, camera)
        before, _ = self._render(self.scene.sh_dc.to(sh_dc), camera)
        weights = coverage.to(self._lpips.device)
        parts = self._parts(camera, weights)
        found = []
        for behind in _BEHIND:
            stylized, original = (self._on(values, coverage, camera, behind) for values in (image, before))
            own, theirs = self._lpips.features(stylized), self._lpips.features(original)
            distance = self._lpips.between(own, theirs, (camera.height, camera.width)).map
            found.append(
                (
                    sum(fraction * judge.distance(own, part) for judge, part, fraction in parts),
                    sum(fraction * judge.color_distance(stylized, part) for judge, part, fraction in parts),
                    _weighted_mean(distance, weights),
                    fmean(_change_of_direction(x, y, weights) for x, y in zip(own, theirs, strict=True)),
                )
            )
        return found

    def _covered(self, camera: Camera) -> float:
        """Return the fraction of a view that is judged."""
        if self._maps is not None:
            return float(self._maps.render(camera).sum(dim=2).mean())
        return float(self._rasterizer.coverage(camera).mean())

    def _render(self, sh_dc: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the image [H, W, 3] over the rasterizer's background, and the coverage [H, W]."""
        rest = torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device)
        if self.scene.sh_degree:
            rest = rest_colors(self._sh_rest, self._means, camera)
        return self._rasterizer.render(view_colors(sh_dc, rest), camera), self._rasterizer.coverage(camera)

    def _on(self, image: Tensor, coverage: Tensor, camera: Camera, behind: float) -> Tensor:
        """Return the image on another background color, clamped to 0 to 1."""
        return shown(image + (1 - coverage)[..., None] * (behind - self._background), camera, self._lpips.device)

    def _parts(self, camera: Camera, coverage: Tensor) -> list[tuple[_StyleJudge, Tensor, float]]:
        """Return each style's judge with its position weights [h, w] and its fraction of the judged area.

        There is one entry per visible region. If the scene has no regions, one entry covers the whole area.
        """
        if self._maps is None:
            return [(self._judges[0], coverage, 1.0)]
        weights = [fraction.to(coverage) for fraction in self._maps.render(camera).unbind(2)]
        sums = [float(fraction.sum(dtype=torch.float64)) for fraction in weights]
        parts = zip(self._judges, weights, sums, strict=True)
        return [(judge, fraction, own / sum(sums)) for judge, fraction, own in parts if own > 0]


class _StyleJudge:
    """Judge that compares images with one style."""

    def __init__(self, lpips: Lpips, style: Style) -> None:
        self._lpips = lpips
        self._style = style.map(lambda image: image.to(lpips.device, torch.float32))
        self._colors = style_moments(self._style)
        self._targets: dict[tuple[int, int], list[Tensor]] = {}

    def color_distance(self, image: Tensor, weights: Tensor) -> float:
        """Return the Frechet distance of the colors of an image [H, W, 3] with position weights [H, W]."""
        return frechet_distance(color_moments(image.reshape(-1, 3), weights.reshape(-1)), self._colors)

    def distance(self, features: list[Tensor], weights: Tensor) -> float:
        """Return the mean relative distance of Gram matrices over the layers of an image.

        Args:
            features: Features [h, w, c] of the image, by layer.
            weights: Position weights [H, W].
        """
        targets = self._grams((int(weights.shape[0]), int(weights.shape[1])))
        distances = []
        for values, target in zip(features, targets, strict=True):
            gram = _gram(values, _pooled(weights, values))
            distances.append(float((gram - target).norm() / target.norm().clamp_min(torch.finfo(target.dtype).tiny)))
        return fmean(distances)

    def _grams(self, view: tuple[int, int]) -> list[Tensor]:
        """Return the style's Gram matrices for a view size.

        Style images are resized as in the loss, but not below AlexNet's minimum size.
        """
        if view not in self._targets:
            every = [self._grams_of(image, view) for image in self._style.images]
            self._targets[view] = [
                reduce(operator.add, [weight * gram for gram, weight in zip(grams, self._style.weights, strict=True)])
                for grams in zip(*every, strict=True)
            ]
        return self._targets[view]

    def _grams_of(self, image: Tensor, view: tuple[int, int]) -> list[Tensor]:
        """Return the Gram matrices of one style image."""
        height, width = style_size((image.shape[0], image.shape[1]), view)
        enlarged = max(1.0, self._lpips.minimum_side / min(height, width))
        features = self._lpips.features(resize_area(image, (round(height * enlarged), round(width * enlarged))))
        return [_gram(x, torch.ones(x.shape[:2], device=x.device)) for x in features]


def saturated(sh_dc: Tensor) -> float:
    """Return the fraction of colors `sh_dc` [N, 3] with a channel outside [0, 1], which no screen can show."""
    colors = COLOR_OFFSET + SH_C0 * sh_dc.double()
    return float(((colors < 0) | (colors > 1)).any(dim=1).double().mean())


def frechet_distance(first: Moments, second: Moments) -> float:
    """Return the Frechet distance of two normal distributions of colors, in 8-bit levels.

    Args:
        first: Mean [3] and covariance [3, 3] of colors in 0 to 1.
        second: Mean and covariance of the other distribution.
    """
    (mean, covariance), (other_mean, other) = first, second
    other_mean, other = other_mean.to(mean), other.to(covariance)
    root = square_root(covariance)
    # Trace of (C C')^1/2. Rounding can make an eigenvalue of 0 slightly negative.
    shared = torch.linalg.eigvalsh(root @ other @ root).clamp_min(0).sqrt().sum()
    spread = covariance.trace() + other.trace() - 2 * shared
    return _LEVELS * float(((mean - other_mean).square().sum() + spread.clamp_min(0)).sqrt())


def _pooled(coverage: Tensor, features: Tensor) -> Tensor:
    """Average coverage [H, W] over the area of each cell of features [h, w, c], giving [h, w]."""
    height, width = features.shape[:2]
    return F.adaptive_avg_pool2d(coverage[None, None].to(features.dtype), (height, width))[0, 0]


def _gram(features: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean of F F^T over the positions of features [h, w, c], as [c, c] float64.

    Sums use the precision of the features. This is accurate enough for the nonnegative terms of a single image.
    """
    flat = features.flatten(0, 1)
    weighted = flat * weights.reshape(-1, 1).to(flat)
    return (weighted.T @ flat).double() / weights.sum(dtype=torch.float64)


def _change_of_direction(x: Tensor, y: Tensor, coverage: Tensor) -> float:
    """Return the weighted mean of 1 - cosine between the features [h, w, c] of two images.

    Positions where both are zero count as unchanged.
    """
    differences = (unit_features(x) - unit_features(y)).square().sum(dim=2) / 2
    return _weighted_mean(differences, _pooled(coverage, x))


def _weighted_mean(values: Tensor, weights: Tensor) -> float:
    return float((values.double() * weights.double()).sum() / weights.sum(dtype=torch.float64))
