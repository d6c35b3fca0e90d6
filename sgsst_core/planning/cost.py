"""What an iteration will cost: pixels through the network, seconds a pixel, bytes that are kept."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.features.partition import Rectangle, computed_twice, covered_region
from sgsst_core.features.vgg import CONTENT_LAYER
from sgsst_core.loss.sos import SosLoss
from sgsst_core.parallel.division import Piece
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import downscale
from sgsst_core.settings import Settings

#: Views whose blend weights are counted; the others are taken to have as many.
SAMPLED_VIEWS = 3


@dataclass(frozen=True)
class Rate:
    """Seconds a pixel: `forward` alone (with statistics), and `both` passes."""

    forward: float
    both: float


def probe(loss: SosLoss, side: int) -> Rate:
    """Time the feature network on a small picture of side x side pixels; the second of two runs counts."""
    cells = torch.rand((1, 3, side // 16 + 1, side // 16 + 1), generator=torch.Generator().manual_seed(0))
    picture = torch.nn.functional.interpolate(cells, size=(side, side), mode="bilinear")[0]
    image = picture.permute(1, 2, 0).contiguous().to(loss.network.device)
    style, view = loss.style_targets(image.flip(0), (side, side)), loss.view_target(image)
    seconds = []
    for gradient in (True, True, False):
        started = time.perf_counter()
        loss.evaluate(image, style, view, [0], gradient=gradient)
        if loss.network.device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    return Rate(forward=seconds[2] / side**2, both=seconds[1] / side**2)


def pieces_of(camera: Camera, loss: SosLoss, region: Rectangle | None, *, coarsest: bool = False) -> tuple[Piece, ...]:
    """What of a view goes through the network: one piece for each scale, or for the coarsest alone.

    Args:
        region: that holds every covered pixel; None where uncovered pixels go through too.
    """
    count = loss.scale_count(camera.height, camera.width)
    pieces = []
    for scale in range(count - 1 if coarsest else 0, count):
        size = (camera.height >> scale, camera.width >> scale)
        part = Rectangle(0, 0, *size) if region is None else covered_region(_scaled(region, scale, size))
        pieces.append(Piece(scale, size, part))
    return tuple(pieces)


@dataclass(frozen=True)
class Work:
    """Pixels through the network in one iteration, mean over views.

    Attributes:
        pixels: forward and backward, halos included.
        again: forward a second time, because activations do not fit.
        without_region: what `pixels` would be if uncovered pixels were not left out.
        tiles: of the full-size view with most tiles.
        peak: most pixels that are held at a time, and what a pass needs beside them counted as such.
    """

    pixels: float
    again: float
    without_region: float
    tiles: int
    peak: float

    @staticmethod
    def of(
        cameras: Sequence[Camera],
        loss: SosLoss,
        looked: Survey,
        covered: Sequence[int],
        *,
        leave_out: bool,
        coarsest: bool = False,
    ) -> Work:
        """The work of all scales, or of the coarsest alone; leave_out: uncovered pixels do not go through."""
        pixels = again = without = 0.0
        tiles = 0
        peak = 0.0
        for index in covered:
            camera = cameras[index]
            count = loss.scale_count(camera.height, camera.width)
            for scale in range(count - 1 if coarsest else 0, count):
                size = (camera.height >> scale, camera.width >> scale)
                region = _scaled(looked.regions[index], scale, size) if leave_out else None
                areas = [tile.outer.pixels for tile in loss.tiles(*size, region)]
                whole = [tile.outer.pixels for tile in loss.tiles(*size)]
                flags = loss.kept(areas)
                twice = computed_twice(areas, flags)
                pixels += sum(areas)
                again += twice
                without += sum(whole)
                tiles = max(tiles, len(areas))
                once = max((area for area, flag in zip(areas, flags, strict=True) if not flag), default=0)
                peak = max(peak, sum(areas) - twice + loss.working * max(areas, default=0), (1 + loss.working) * once)
        views = len(covered)
        return Work(pixels / views, again / views, without / views, tiles, peak)

    def seconds(self, rate: Rate) -> float:
        """Of the feature network and the statistics in one iteration."""
        return self.pixels * rate.both + self.again * rate.forward

    def peak_bytes(self, loss: SosLoss) -> int:
        """Activations at their peak."""
        return int(self.peak * loss.network.held_bytes_per_pixel())


def _scaled(region: Rectangle, scale: int, size: tuple[int, int]) -> Tensor:
    """Coverage [h, w] that is 1 in a region of the full-size view, at a scale."""
    coverage = torch.zeros((size[0] << scale, size[1] << scale))
    coverage[region.slices] = 1
    return downscale(coverage, scale)


@dataclass(frozen=True)
class RasterCost:
    """Of the views' blend weights.

    Attributes:
        seconds: of a render and its gradient with weights computed anew, mean over some views.
        kept_seconds: the same with kept weights; None where not even one view's fit the memory.
        bytes: of the kept weights of all views, float32.
        half_bytes: the same, half precision.
    """

    seconds: float
    kept_seconds: float | None
    bytes: int
    half_bytes: int


def raster_cost(
    scene: Scene, cameras: Sequence[Camera], covered: Sequence[int], rasterizer: Rasterizer, near: float, memory: int
) -> RasterCost:
    """Count and time blend weights on a few of the views, evenly spread."""
    count = min(SAMPLED_VIEWS, len(covered))
    sample = [cameras[covered[(2 * part + 1) * len(covered) // (2 * count)]] for part in range(count)]
    cached = CachedRasterizer(scene, near=near, device=rasterizer.device)
    half = CachedRasterizer(scene, near=near, device=rasterizer.device, precision="half")
    sizes = [cached.operator_bytes(camera) for camera in sample]
    half_size = half.operator_bytes(sample[count // 2])
    seconds = sum(_raster_seconds(rasterizer, len(scene), camera) for camera in sample) / count
    middle = sample[count // 2]
    kept = _raster_seconds(cached, len(scene), middle) if sizes[count // 2] <= memory else None
    total = sum(sizes) * len(covered) // count
    return RasterCost(seconds, kept, total, total * half_size // max(sizes[count // 2], 1))


def _raster_seconds(rasterizer: Rasterizer, gaussians: int, camera: Camera) -> float:
    """Of the second of two renders with gradient: the first one prepares the view."""
    colours = torch.full((gaussians, 3), 0.5, device=rasterizer.device)
    seconds = 0.0
    for _ in range(2):
        started = time.perf_counter()
        rasterizer.colour_gradient(rasterizer.render(colours, camera), camera)
        if rasterizer.device.type == "cuda":
            torch.cuda.synchronize()
        seconds = time.perf_counter() - started
    return seconds


def content_bytes(cameras: Sequence[Camera], covered: Sequence[int], settings: Settings, loss: SosLoss) -> int:
    """Content features of all views and scales."""
    if not settings.content_weight:
        return 0
    value = torch.finfo(loss.network.dtype).bits // 8
    cells = sum(
        (cameras[index].height >> scale + 3) * (cameras[index].width >> scale + 3)
        for index in covered
        for scale in range(loss.scale_count(cameras[index].height, cameras[index].width))
    )
    return cells * loss.network.channels(CONTENT_LAYER) * value


def image_bytes(cameras: Sequence[Camera]) -> int:
    """Images of one iteration: the render, its gradient, and their float32 copies on the way."""
    return max(camera.width * camera.height for camera in cameras) * 3 * 4 * 6
