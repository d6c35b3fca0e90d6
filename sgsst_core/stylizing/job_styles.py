"""Styles of a job: one style, or one for each region of the scene, prepared as the settings require."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy import ndimage
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.targets import StyleTargets, by_band, combined
from sgsst_core.parallel.division import Size
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.regions.definition import Regions
from sgsst_core.regions.maps import ContentMaps, DepthBands, RegionMaps, ViewMaps
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import ColorSubspace, color_subspace_of
from sgsst_core.scene.pyramid import style_size
from sgsst_core.settings import MAX_RESOLUTION, Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.warm_start import in_colors_of, in_luminance_of, luminance_start, warm_start


@dataclass(frozen=True)
class JobStyles:
    """Styles of a job, prepared as its settings require.

    Attributes:
        own: Default style; if one region contains everything that the views show, the style of that region.
        each: Style of each region in `Regions.active`; empty if views need no region maps.
        bands: Number of depth bands, which is that of the scales of the largest view; 0 for strokes that have the same
            size on the whole screen.
        mean_level: See `maps.mean_level`.
        content_weights: [N], content weight of each Gaussian; None for that of the settings everywhere.
    """

    own: Style
    regions: Regions | None = None
    each: tuple[Style, ...] = ()
    bands: int = 0
    mean_level: float = 0.0
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

    def targets(self, loss: SosLoss, view_size: Size) -> StyleTargets:
        """Compute the targets for views of a size (height, width); see `TargetBuilder.of_style`."""
        if self.bands:
            return by_band(loss.targets.of_style(self.own, view_size), self.bands)
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

    def maps(self, rasterizer: Rasterizer, rows: Tensor | None = None) -> ViewMaps | None:
        """Return the renderer of the maps of regions or depth bands; None if the views need none.

        Args:
            rows: [N] bool, Gaussians that the rasterizer contains; None for all.
        """
        if self.bands:
            return DepthBands(self.bands, self.mean_level, rasterizer)
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
    spun = ndimage.rotate(style.double().numpy(), rest, axes=(1, 0), reshape=True, order=3, mode="nearest")
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
