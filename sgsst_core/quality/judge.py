"""Independent judgment of a stylized scene by AlexNet, whose features no job optimizes.

A job's own loss cannot show whether its result is good, because the job minimizes this loss. Gram matrices of AlexNet's
features measure how close textures are to the style; their change measures the loss of content. Color statistics
measure how close colors are to the style. Only pixels covered by Gaussians count. Every view is judged on a black and
on a white background, because the background of an object scan is arbitrary. Features near a silhouette see the
background as well; `interior_style` and `sliced_features` therefore use only features whose whole receptive field lies
inside the object.

Content is measured by LPIPS (Zhang, Isola, Efros, Shechtman, Wang, "The Unreasonable Effectiveness of Deep Features as
a Perceptual Metric", CVPR 2018, equation 1). Features of five layers are scaled to unit length at every position, and

    d(x, y) = sum over layers l of the mean over positions of sum over channels c of w_lc (x_lc - y_lc)^2

with learned weights w >= 0 (version 0.1 of the published weights, which papers report). SSIM (Wang, Bovik, Sheikh,
Simoncelli, "Image Quality Assessment: From Error Visibility to Structural Similarity", 2004) is reported beside it.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from statistics import fmean

import scipy  # imports its modules at first use
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.features.network_weights import list_network_weights, load_perceptual
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.colors import luminance, resize_area, style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.style import Moments, Style, color_moments, square_root, style_moments
from sgsst_core.stylizing.styles import JobStyles

#: Maximum longer side of judged views in pixels. The limit keeps results at different resolutions comparable, and
#: bounds the cost of large views.
JUDGED_SIDE = 1024
#: Measures of each image.
_MEASURES = ("style", "color_distance", "content", "ssim", "interior_style", "sliced_features")
#: Gray values of the backgrounds that each view is judged on: black and white.
_BACKGROUNDS = (0.0, 1.0)
#: Minimum coverage of judged views.
_MIN_COVERAGE = 1e-3
#: Minimum coverage of every pixel that an interior feature sees.
_INTERIOR = 0.9
#: Minimum number of interior features of a layer. Layers with fewer are left out of a view's interior measures.
_MIN_INTERIOR = 64
#: Number of random directions of the sliced Wasserstein distance, and number of quantiles along each.
_DIRECTIONS, _QUANTILES = 64, 256
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
        ssim: SSIM of the luminance against the unstylized scene; 1 for identical images.
        background_sensitivity: Absolute difference in `style` between black and white background, averaged over views.
        saturated: Fraction of the Gaussians with a color channel outside [0, 1].
        interior_style: `style` over features that see no background (see `Lpips.min_coverage`), averaged over layers
            with enough of them; None if no view has any.
        sliced_features: Sliced Wasserstein distance of order 1 between these features and the style's (Rabin et al.
            2011), relative to the style's mean absolute projection, averaged likewise. It compares whole
            distributions, not only second moments; no job optimizes it.
    """

    style: float
    color_distance: float
    content: float
    ssim: float
    background_sensitivity: float
    saturated: float
    interior_style: float | None = None
    sliced_features: float | None = None


class Judge:
    """Judge that compares colors of one scene with one style.

    Args:
        style: Style image [H, W, 3] in 0 to 1; or a weighted mixture of images, whose Gram matrices and color
            statistics are averaged; or the styles of the scene's regions. For regions, `Judgment.style` and
            `Judgment.color_distance` are averaged over regions, weighted by their fraction of a view, and frozen
            regions are ignored.
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
        device = rasterizer.device
        self.scene = replace(scene, means=scene.means.to(device), sh_rest=scene.sh_rest.to(device))
        self._lpips, self._rasterizer = lpips, rasterizer
        styles = style if isinstance(style, JobStyles) else JobStyles(Style.of(style))
        self._judges = [_StyleJudge(lpips, each) for each in styles.each or (styles.own,)]
        self._maps = styles.maps(rasterizer)
        self._background = torch.tensor(background, dtype=rasterizer.dtype, device=rasterizer.device)
        self.cameras = []
        for camera in (resized(camera, min(JUDGED_SIDE, camera.side)) for camera in cameras):
            if min(camera.width, camera.height) >= MIN_SIDE:
                judged = rasterizer.coverage(camera) if self._maps is None else self._maps.render(camera).sum(dim=2)
                if float(judged.mean()) >= _MIN_COVERAGE:
                    self.cameras.append(camera)

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
        known = {name: [image[name] for view in views for image in view if name in image] for name in _MEASURES}
        means = {name: fmean(values) if values else None for name, values in known.items()}
        sensitivity = fmean(abs(on_black["style"] - on_white["style"]) for on_black, on_white in views)
        return Judgment(**means, background_sensitivity=sensitivity, saturated=saturated(sh_dc))  # type: ignore[arg-type]

    @torch.no_grad()
    def renders(self, sh_dc: Tensor, camera: Camera) -> list[Tensor]:
        """Render colors `sh_dc` [N, 3] on black and on white, as images [H, W, 3]."""
        image, coverage = self._render(sh_dc.detach().to(self._rasterizer.device), camera)
        return [self._on(image, coverage, camera, level) for level in _BACKGROUNDS]

    def _view(self, camera: Camera, sh_dc: Tensor) -> list[dict[str, float]]:
        """Return the measures of a view, on black and on white background, by their names in `Judgment`."""
        image, coverage = self._render(sh_dc, camera)
        before, _ = self._render(self.scene.sh_dc.to(sh_dc), camera)
        weights = coverage.to(self._lpips.device)
        parts = self._parts(camera, weights)
        measures = []
        for level in _BACKGROUNDS:
            stylized, original = (self._on(values, coverage, camera, level) for values in (image, before))
            own, theirs = self._lpips.features(stylized), self._lpips.features(original)
            distance = self._lpips.between(own, theirs, (camera.height, camera.width))
            measures.append(
                {
                    "style": sum(fraction * judge.distance(own, part) for judge, part, fraction in parts),
                    "color_distance": sum(
                        fraction * judge.color_distance(stylized, part) for judge, part, fraction in parts
                    ),
                    "content": _weighted_mean(distance, weights),
                    "ssim": _weighted_mean(ssim(stylized, original).to(weights.device), weights),
                    **_interior(own, parts),
                }
            )
        return measures

    def _render(self, sh_dc: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the image [H, W, 3] over the rasterizer's background, and the coverage [H, W]."""
        colors = scene_colors(replace(self.scene, sh_dc=sh_dc), camera, self._rasterizer.device)
        return self._rasterizer.render(colors, camera), self._rasterizer.coverage(camera)

    def _on(self, image: Tensor, coverage: Tensor, camera: Camera, level: float) -> Tensor:
        """Return the image on another background color, clamped to 0 to 1."""
        return shown(image + (1 - coverage)[..., None] * (level - self._background), camera, self._lpips.device)

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


def _interior(features: list[Tensor], parts: list[tuple[_StyleJudge, Tensor, float]]) -> dict[str, float]:
    """Return the interior measures of an image, averaged over the regions that have interior features, if any has.

    `parts` has the judge, the position weights [H, W] and the fraction of the area of each region.
    """
    distances = [(judge.interior(features, part), fraction) for judge, part, fraction in parts]
    known = [(pair, fraction) for pair, fraction in distances if pair is not None]
    total = sum(fraction for _, fraction in known)
    return {
        name: sum(fraction * pair[index] for pair, fraction in known) / total
        for index, name in enumerate(("interior_style", "sliced_features"))
        if known
    }


#: A style's Gram matrix [c, c] of one layer, and quantiles of its features along random directions,
#: [_QUANTILES, _DIRECTIONS].
_LayerTarget = tuple[Tensor, Tensor]


class _StyleJudge:
    """Judge that compares images with one style."""

    def __init__(self, lpips: Lpips, style: Style) -> None:
        self._lpips = lpips
        self._style = style.map(lambda image: image.to(lpips.device, torch.float32))
        self._colors = style_moments(self._style)
        self._targets: dict[tuple[int, int], list[_LayerTarget]] = {}

    def color_distance(self, image: Tensor, weights: Tensor) -> float:
        """Return the Frechet distance of the colors of an image [H, W, 3] with position weights [H, W]."""
        return frechet_distance(color_moments(image.reshape(-1, 3), weights.reshape(-1)), self._colors)

    def distance(self, features: list[Tensor], weights: Tensor) -> float:
        """Return the mean relative distance of Gram matrices over the layers [h, w, c] of an image.

        Positions of the image have weights [H, W].
        """
        targets = self._layers((int(weights.shape[0]), int(weights.shape[1])))
        return fmean(
            _relative(_gram(values, _pooled(weights, values)), gram)
            for values, (gram, _) in zip(features, targets, strict=True)
        )

    def interior(self, features: list[Tensor], coverage: Tensor) -> tuple[float, float] | None:
        """Return the Gram and the sliced Wasserstein distance over interior features; None if there are too few.

        Features [h, w, c] are those of the layers, and coverage [H, W] that of the object or of the region.
        """
        targets = self._layers((int(coverage.shape[0]), int(coverage.shape[1])))
        distances = []
        minima = self._lpips.min_coverage(coverage)
        for values, covered, (gram, quantiles) in zip(features, minima, targets, strict=True):
            inside = values[covered >= _INTERIOR][None]  # [1, n, c]
            if inside.shape[1] >= _MIN_INTERIOR:
                ones = torch.ones(inside.shape[:2], device=inside.device)
                # Mean difference of quantiles, relative to the style's mean absolute value.
                size = quantiles.abs().mean().clamp_min(torch.finfo(quantiles.dtype).tiny)
                sliced = float((_quantiles(inside, ones) - quantiles).abs().mean() / size)
                distances.append((_relative(_gram(inside, ones), gram), sliced))
        return (fmean(gram for gram, _ in distances), fmean(sliced for _, sliced in distances)) if distances else None

    def _layers(self, view: tuple[int, int]) -> list[_LayerTarget]:
        """Return the style's features of each layer for a view size."""
        if view not in self._targets:
            every = []
            for image in self._style.images:  # resized as in the loss, but not below AlexNet's minimum size
                height, width = style_size((image.shape[0], image.shape[1]), view)
                enlarged = max(1.0, MIN_SIDE / min(height, width))
                resized_image = resize_area(image, (round(height * enlarged), round(width * enlarged)))
                every.append(self._lpips.features(resized_image))
            self._targets[view] = [self._target(layers) for layers in zip(*every, strict=True)]
        return self._targets[view]

    def _target(self, layers: tuple[Tensor, ...]) -> _LayerTarget:
        """Return the weighted mean of the style images' features [h, w, c] of one layer."""
        parts = list(zip(layers, self._style.weights, strict=True))
        ones = [torch.ones(x.shape[:2], device=x.device) for x in layers]
        gram = reduce(operator.add, [weight * _gram(x, one) for (x, weight), one in zip(parts, ones, strict=True)])
        together = torch.cat([x.flatten(0, 1) for x in layers])[None]
        weights = torch.cat(
            [(weight / one.numel() * one).flatten() for (_, weight), one in zip(parts, ones, strict=True)]
        )
        return gram, _quantiles(together, weights[None])


def saturated(sh_dc: Tensor) -> float:
    """Return the fraction of colors `sh_dc` [N, 3] with a channel outside [0, 1], which no screen can show."""
    colors = COLOR_OFFSET + SH_C0 * sh_dc.double()
    return float(((colors < 0) | (colors > 1)).any(dim=1).double().mean())


def frechet_distance(first: Moments, second: Moments) -> float:
    """Return the Frechet distance of two normal distributions of colors in 0 to 1, in 8-bit levels."""
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


def _relative(gram: Tensor, target: Tensor) -> float:
    """Return the distance of two Gram matrices relative to the target's norm."""
    return float((gram - target).norm() / target.norm().clamp_min(torch.finfo(target.dtype).tiny))


def _quantiles(features: Tensor, weights: Tensor) -> Tensor:
    """Return the quantiles of features [h, w, c] with weights [h, w] along fixed random directions.

    Returns:
        Quantiles [_QUANTILES, _DIRECTIONS] float64, at the midpoints of equal fractions.
    """
    generator = torch.Generator().manual_seed(0)
    directions = F.normalize(torch.randn(features.shape[2], _DIRECTIONS, generator=generator), dim=0)
    ordered, order = (features.flatten(0, 1) @ directions.to(features)).sort(dim=0)
    cumulative = weights.flatten().double()[order].cumsum(0)
    fractions = (torch.arange(_QUANTILES, dtype=torch.float64, device=features.device) + 0.5) / _QUANTILES
    wanted = (fractions[:, None] * cumulative[-1]).T.contiguous()
    indices = torch.searchsorted(cumulative.T.contiguous(), wanted).T
    return ordered.gather(0, indices.clamp_max(len(ordered) - 1)).double()


def _weighted_mean(values: Tensor, weights: Tensor) -> float:
    return float((values.double() * weights.double()).sum() / weights.sum(dtype=torch.float64))


#: Standard deviation in pixels of SSIM's window, and radius in deviations: 11 x 11 pixels, as published.
_SSIM_WINDOW = (1.5, 3.5)
#: Constants of SSIM for values from 0 to 1, as published.
_SSIM_CONSTANTS = (0.01**2, 0.03**2)


def ssim(first: Tensor, second: Tensor) -> Tensor:
    """Return the SSIM of the luminance of two images [H, W, 3] from 0 to 1 at every pixel, [H, W] float64 on the CPU.

    Windows continue beyond the border by reflection.
    """
    x, y = (luminance(image.double()).cpu().numpy() for image in (first, second))
    deviation, radius = _SSIM_WINDOW
    mean_x, mean_y, xx, yy, xy = (
        scipy.ndimage.gaussian_filter(values, deviation, truncate=radius) for values in (x, y, x * x, y * y, x * y)
    )
    a, b = _SSIM_CONSTANTS
    of_means = (2 * mean_x * mean_y + a) / (mean_x**2 + mean_y**2 + a)
    of_deviations = (2 * (xy - mean_x * mean_y) + b) / ((xx - mean_x**2) + (yy - mean_y**2) + b)
    return torch.from_numpy(of_means * of_deviations)


#: (stride, padding) of AlexNet's convolutions (Krizhevsky 2014, the one-tower version of torchvision).
_ALEX_CONVOLUTIONS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))
#: Kernel sizes of these convolutions.
_ALEX_KERNELS = (11, 5, 3, 3, 3)
#: Convolutions of AlexNet that follow a 3x3 max pool of stride 2, counted from 1.
_ALEX_POOLED = (2, 3)
#: Minimum length in pixels of the shorter side. On smaller images, the output of the deepest layer is empty.
MIN_SIDE = 31
#: Term added to the length of feature vectors, as in the published code: zero vectors stay zero instead of becoming
#: 0/0.
_LENGTH_EPS = 1e-10


class Lpips:
    """LPIPS with AlexNet, which the authors recommend as a metric.

    Args:
        dtype: torch.float32, or torch.float64 for the reference.
        folder: Folder of the weights; None for the cache folder.

    Attributes:
        network: Name of the network in reports.

    Raises:
        WeightsError: If the weights are missing or corrupt.
    """

    network = "alex"

    def __init__(
        self,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        folder: Path | None = None,
    ) -> None:
        self.dtype, self.device = dtype, torch.device(device)
        self._tensors = {name: tensor.to(device, dtype) for name, tensor in load_perceptual(folder).items()}
        self._heads = [self._tensors[f"linear{layer}.weight"] for layer in range(1, 6)]

    @torch.no_grad()
    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the distance of two images [H, W, 3] of the same size, with values 0 to 1 in any floating dtype.

        The sides of the images must be at least `MIN_SIDE`.

        Returns:
            Distance per pixel [H, W]: each layer's distances upsampled bilinearly and summed over layers (published as
                `spatial`). Its mean is LPIPS as published, apart from the upsampling at the border; 0 for equal images.
        """
        return self.between(self.features(first), self.features(second), (first.shape[0], first.shape[1]))

    @torch.no_grad()
    def between(self, first: list[Tensor], second: list[Tensor], size: tuple[int, int]) -> Tensor:
        """Return the `distance` of two images of size (height, width) from their `features`."""
        spatial = torch.zeros(size, dtype=self.dtype, device=self.device)
        for x, y, head in zip(first, second, self._heads, strict=True):
            distances = ((_unit_features(x) - _unit_features(y)).square_() @ head)[None, None]
            spatial += F.interpolate(distances, size=size, mode="bilinear", align_corners=False)[0, 0]
        return spatial

    @torch.no_grad()
    def features(self, image: Tensor) -> list[Tensor]:
        """Return the features [h, w, c] of the five layers for an image [H, W, 3] with values 0 to 1.

        The sides of the image must be at least `MIN_SIDE`.
        """
        tensors, outputs = self._tensors, []
        rgb = image.to(self.device, self.dtype)
        x = (rgb * tensors["input_scale"] + tensors["input_shift"]).permute(2, 0, 1).unsqueeze(0)
        for layer, (stride, padding) in enumerate(_ALEX_CONVOLUTIONS, start=1):
            if layer in _ALEX_POOLED:
                x = F.max_pool2d(x, 3, 2)
            weight, bias = tensors[f"conv{layer}.weight"], tensors[f"conv{layer}.bias"]
            x = F.conv2d(x, weight, bias, stride, padding).relu_()
            outputs.append(x[0].permute(1, 2, 0))
        return outputs

    def min_coverage(self, coverage: Tensor) -> list[Tensor]:
        """Return the smallest coverage inside the receptive field of each feature of AlexNet.

        Args:
            coverage: Coverage [H, W] of an image's pixels. Beyond the image's border, nothing counts.

        Returns:
            Minimum [h, w] for each of the five layers, at the positions of `features`.
        """
        hidden, minima = -coverage.to(self.device, self.dtype)[None, None], []
        for layer, (stride, padding) in enumerate(_ALEX_CONVOLUTIONS, start=1):
            if layer in _ALEX_POOLED:
                hidden = F.max_pool2d(hidden, 3, 2)
            hidden = F.max_pool2d(hidden, _ALEX_KERNELS[layer - 1], stride, padding)
            minima.append(-hidden[0, 0])
        return minima


def load_lpips_or_none(device: torch.device | str = "cpu", folder: Path | None = None) -> Lpips | None:
    """Load LPIPS with AlexNet in float32, or return None if its weights (installed along with VGG16's) are missing.

    Raises:
        WeightsError: If the weights are installed but corrupt.
    """
    installed = any(entry.name == "lpips_alex" and entry.path for entry in list_network_weights(folder))
    return Lpips(device=device, folder=folder) if installed else None


def _unit_features(features: Tensor) -> Tensor:
    """Scale features [h, w, c] to unit length at every position."""
    lengths: Tensor = torch.linalg.vector_norm(features, dim=2, keepdim=True)
    return features / (lengths + _LENGTH_EPS)


def shown(image: Tensor, camera: Camera, device: torch.device) -> Tensor:
    """Return an image [H, W, 3] of a view as a screen shows it: clamped to 0 to 1, on the given device.

    Raises:
        ValueError: If the image contains NaN or infinity.
    """
    image = image.detach().to(device)
    if not bool(image.isfinite().all()):
        raise ValueError(f"image of view {camera.name!r}: holds NaN or infinity")
    return image.clamp(0, 1).contiguous()
