"""`coarse`: box average and blend weights of a view, cached as a single operator for phase 1.

At scale s the optimizer sees image_s = D (W c + T_final background), where D is the 2^s x 2^s box average
(`pyramid.downscale`). Geometry is frozen, so D W never changes. It has one weight per Gaussian and square of 2^s x 2^s
pixels, so it is much smaller than W and correspondingly faster to apply.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.compiled import kernel_threads
from sgsst_core.constants import RASTER_TILE
from sgsst_core.rasterizer import coarse_kernels, kernels
from sgsst_core.rasterizer.arguments import CameraKey, Rows, camera_key, check_colors
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.plain_survey import plain_survey
from sgsst_core.rasterizer.tile_intersections import TileIntersections, run_starts, tile_grid
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.pyramid import add_upscaled_, downscale

_CPU = torch.device("cpu")
#: Scale at which a raster tile is one pixel. Images at coarser scales are averages of images at this scale.
_LARGEST_PIECE_SCALE = RASTER_TILE.bit_length() - 1


@dataclass(frozen=True)
class _Grid:
    """Layout of a view's complete squares of 2^scale pixels."""

    size: tuple[int, int]  # height and width in pixels of the part covered by complete squares
    across: int  # number of raster tiles in a row of the whole view
    piece_scale: int  # scale of the cached weights: `scale`, but at most one raster tile

    @classmethod
    def of(cls, camera: Camera, scale: int) -> _Grid:
        """Return the grid of a view at a scale.

        Raises:
            ValueError: If the view does not contain a single square.
        """
        size = (camera.height >> scale << scale, camera.width >> scale << scale)
        if 0 in size:
            raise ValueError(
                f"scale {scale} of view {camera.name!r}: {camera.width}x{camera.height} pixels hold no square of "
                f"{1 << scale} pixels a side; use a smaller scale"
            )
        return cls(size, tile_grid(camera)[0], min(scale, _LARGEST_PIECE_SCALE))

    def shape(self, scale: int) -> tuple[int, int]:
        """Return height and width of the view's image at a scale."""
        return self.size[0] >> scale, self.size[1] >> scale


@dataclass(frozen=True)
class _Counts:
    """Sizes of a view's operator, counted before it is built."""

    tile_pieces: NDArray[np.int64]  # [raster tiles]
    slot_used: NDArray[np.bool_]  # [E], whether a (Gaussian, raster tile) pair has a piece

    @property
    def pieces(self) -> int:
        return int(self.tile_pieces.sum())

    def nbytes(self, isects: TileIntersections, grid: _Grid) -> int:
        """Return the size in bytes of all arrays of a `CoarseOperator`."""
        height, width = grid.shape(grid.piece_scale)
        offsets = 8 * (len(self.tile_pieces) + 1) + isects.first_slots.nbytes + isects.projection.gaussians.nbytes
        return offsets + 4 * height * width + self.pieces * (8 + 4 * (RASTER_TILE >> grid.piece_scale) ** 2)


def _count(isects: TileIntersections, grid: _Grid, alpha_max: float) -> _Counts:
    """Compute the sizes of a view's operator; takes about as long as one render."""
    counts = _Counts(np.zeros(len(isects.starts) - 1, dtype=np.int64), np.zeros(len(isects.ranks), dtype=np.bool_))
    tiles = (isects.ranks, isects.slots, isects.starts, isects.projection.values)
    with kernel_threads():
        coarse_kernels.count_pieces(*tiles, grid.size, grid.across, alpha_max, counts.tile_pieces, counts.slot_used)
    return counts


class CoarseOperator:
    """Operator D W of one view, at scale `_LARGEST_PIECE_SCALE` or finer. See `coarse_kernels` for the layout."""

    def __init__(self, isects: TileIntersections, counts: _Counts, grid: _Grid, alpha_max: float) -> None:
        self.scale, self.across = grid.piece_scale, grid.across
        self.gaussians = isects.projection.gaussians
        slot_starts = run_starts(counts.slot_used)
        self.first_slots = slot_starts[isects.first_slots]
        self.pieces = coarse_kernels.Pieces(
            starts=run_starts(counts.tile_pieces),
            gaussians=np.empty(counts.pieces, dtype=np.int32),
            slots=np.empty(counts.pieces, dtype=np.int32),
            weights=np.empty(counts.pieces * (RASTER_TILE >> self.scale) ** 2, dtype=np.float32),
        )
        self.transmittance = np.empty(grid.shape(self.scale), dtype=np.float32)
        tiles = (isects.ranks, isects.slots, isects.starts, isects.projection.values, self.gaussians)
        place = (grid.size, grid.across, self.scale)
        with kernel_threads():
            coarse_kernels.keep_pieces(*tiles, *place, alpha_max, slot_starts, self.pieces, self.transmittance)

    @property
    def nbytes(self) -> int:
        """Memory use in bytes."""
        return sum(a.nbytes for a in (*self.pieces, self.transmittance, self.gaussians, self.first_slots))

    def render(self, colors: NDArray[np.float32], background: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image [h, w, 3] of colors [N, 3]."""
        image = np.empty((*self.transmittance.shape, 3), dtype=np.float32)
        with kernel_threads():
            coarse_kernels.apply_pieces(
                self.pieces, colors, background, self.transmittance, self.across, self.scale, image
            )
        return image

    def color_gradient(self, image_gradient: NDArray[np.float32], gaussians: int) -> NDArray[np.float32]:
        """Return W^T D^T dL/dimage_s, [gaussians, 3], given the image gradient [h, w, 3]."""
        gradient = np.zeros((gaussians, 3), dtype=np.float32)
        slot_gradients = np.empty((len(self.pieces.slots), 3), dtype=np.float32)
        with kernel_threads():
            coarse_kernels.apply_transposed_pieces(self.pieces, image_gradient, self.across, self.scale, slot_gradients)
            kernels.add_slots(slot_gradients, self.first_slots, self.gaussians, gradient)
        return gradient


class CoarseRasterizer:
    """Implementation of `sgsst_core.rasterizer.Rasterizer` at a coarse scale, on the CPU.

    Operators are cached in the order of the views' first use, or of the calls of `keep`, until the next one would
    exceed `max_bytes`; nothing is ever evicted. If a view has no cached operator, `cpu` renders it at full size and the
    image is averaged, with the same result up to rounding. Results are bit-identical for any number of threads.

    Methods take cameras of full-size views. Rows and columns outside complete squares of 2^scale pixels are dropped, as
    in `pyramid.downscale`. If a view contains no complete square, its image would be empty, and methods raise
    ValueError.

    Args:
        cpu: Rasterizer whose scene, tile intersections, background, near plane and limit of alpha this object shares.
        scale: Scale, 1 or more.
        max_bytes: Memory budget for operators; None for no limit.
        at_first_use: Whether to cache operators at first use; if False, only by `keep` (see `CachedRasterizer`).

    Raises:
        ValueError: If the scale is less than 1.
    """

    name = "coarse"
    device = _CPU
    dtype = torch.float32

    def __init__(
        self, cpu: CpuRasterizer, scale: int = 1, max_bytes: int | None = None, *, at_first_use: bool = True
    ) -> None:
        if scale < 1:
            raise ValueError(f"scale {scale}: a coarse operator is for scale 1 or more; use `cached` for full size")
        self.scene = cpu.scene
        self.scale = scale
        self._cpu = cpu
        self._at_first_use = at_first_use
        self._operators: Cache[tuple[CameraKey, int], CoarseOperator] = Cache(max_bytes)

    def at(self, scale: int) -> CoarseRasterizer:
        """Return a rasterizer of the same scene at another scale, which shares this one's cache and memory budget."""
        other = CoarseRasterizer(self._cpu, scale, at_first_use=self._at_first_use)
        other._operators = self._operators
        return other

    @property
    def cached_bytes(self) -> int:
        """Size in bytes of all cached operators, at all scales."""
        return self._operators.used

    def operator_bytes(self, camera: Camera) -> int:
        """Return the size in bytes that a view's operator would have; takes about as long as one render."""
        return self._counted(camera, _Grid.of(camera, self.scale))[0]

    def keep(self, camera: Camera) -> bool:
        """Cache a view's operator if it fits, and return whether it is cached.

        The first call for a view decides whether its operator fits; later calls do not reconsider this.
        """
        return self._operator(camera, _Grid.of(camera, self.scale), add=True) is not None

    def is_cached(self, camera: Camera) -> bool:
        """Return whether the view has a cached operator."""
        return (camera_key(camera), self.scale) in self._operators

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return the float32 image [h, W >> scale, 3] of colors [N, 3] over the background.

        `rows` counts rows of this scale, not of the full-size view.
        """
        grid = _Grid.of(camera, self.scale)
        band = self._band(camera, rows)
        values = check_colors(colors, len(self.scene), torch.float32, _CPU)
        operator = self._operator(camera, grid)
        if operator is None:
            return downscale(self._cpu.render(values, camera, self._full_size(band)), self.scale)
        image = torch.from_numpy(operator.render(values.numpy(), self._cpu.background))
        return downscale(image, self.scale - operator.scale)[slice(*band)]

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return 1 - T_final, [h, W >> scale] float32 in [0, 1]: how much of each pixel the Gaussians cover."""
        grid = _Grid.of(camera, self.scale)
        band = self._band(camera, rows)
        operator = self._operator(camera, grid)
        if operator is None:
            return downscale(self._cpu.coverage(camera, self._full_size(band)), self.scale)
        return 1 - downscale(torch.from_numpy(operator.transmittance), self.scale - operator.scale)[slice(*band)]

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return W^T D^T dL/dimage_s, [N, 3] float32, given the image gradient [h, W >> scale, 3] of some rows."""
        grid = _Grid.of(camera, self.scale)
        band = self._band(camera, rows)
        pixels = self._whole(self._checked(image_gradient, camera, band), grid, band)
        operator = self._operator(camera, grid)
        if operator is None:
            whole = torch.zeros((camera.height, camera.width, 3))
            add_upscaled_(whole, pixels, self.scale)
            return self._cpu.color_gradient(whole, camera)
        if self.scale > operator.scale:
            of_squares = pixels
            pixels = torch.zeros((*grid.shape(operator.scale), 3))
            add_upscaled_(pixels, of_squares, self.scale - operator.scale)
        return torch.from_numpy(operator.color_gradient(pixels.numpy(), len(self.scene)))

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, W >> scale], and each Gaussian's blend weight summed over all pixels [N]."""
        return plain_survey(self, camera)

    def _operator(self, camera: Camera, grid: _Grid, *, add: bool = False) -> CoarseOperator | None:
        """Return the view's cached operator, or None. With `add` or `at_first_use` it is built first, if it fits."""
        key = (camera_key(camera), self.scale)
        if add or self._at_first_use:
            self._operators.add(key, lambda: self._counted(camera, grid))
        return self._operators.values.get(key)

    def _counted(self, camera: Camera, grid: _Grid) -> tuple[int, Callable[[], CoarseOperator]]:
        """Return the size in bytes of a view's operator, and a function that builds it."""
        isects, alpha_max = self._cpu.intersections(camera), self._cpu.alpha_max
        counts = _count(isects, grid, alpha_max)
        return counts.nbytes(isects, grid), lambda: CoarseOperator(isects, counts, grid, alpha_max)

    def _band(self, camera: Camera, rows: Rows | None) -> Rows:
        """Validate a band of rows of this scale and return it as (start, stop); None stands for the whole view."""
        height = camera.height >> self.scale
        start, stop = rows or (0, height)
        if not 0 <= start < stop <= height:
            raise ValueError(
                f"rows {start} to {stop}: a band of view {camera.name!r} at scale {self.scale} lies within 0 to "
                f"{height}"
            )
        return start, stop

    def _full_size(self, band: Rows) -> Rows:
        return band[0] << self.scale, band[1] << self.scale

    def _checked(self, image_gradient: Tensor, camera: Camera, band: Rows) -> Tensor:
        expected = (band[1] - band[0], camera.width >> self.scale, 3)
        if tuple(image_gradient.shape) != expected:
            raise ValueError(
                f"gradient of shape {tuple(image_gradient.shape)}: scale {self.scale} of view {camera.name!r} needs "
                f"{expected}"
            )
        return image_gradient.detach().to(device=_CPU, dtype=torch.float32).contiguous()

    def _whole(self, pixels: Tensor, grid: _Grid, band: Rows) -> Tensor:
        """Return the image gradient of the whole view, given the gradient of a band. It is zero outside the band."""
        size = grid.shape(self.scale)
        if band == (0, size[0]):
            return pixels
        whole = torch.zeros((*size, 3))
        whole[slice(*band)] = pixels
        return whole
