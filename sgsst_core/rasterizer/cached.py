"""`cached`: rasterizer that stores the blend weights of a view and reapplies them in every step.

Geometry is frozen, so the blend weights W of a view never change: an image is W c + T_final background, the color
gradient is W^T dL/dimage, and rasterization is reduced to reading W from memory. Weights are stored on the device that
applies them, in a layout for this device: `strips` on the CPU, `triton_cached` on GPUs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.constants import ALPHA_MAX, NEAR
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.arguments import (
    CameraKey,
    Rows,
    camera_key,
    check_colors,
    check_image_gradient,
    check_rows,
)
from sgsst_core.rasterizer.cached_weights import CachedWeights, CountedWeights, Precision
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.strips import CountedStrips
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.rasterizer.triton_cached import CountedPieces
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


@dataclass(frozen=True)
class _CachedBand:
    """Cached weights of a band of rows."""

    band: Rows
    weights: CachedWeights


class CachedRasterizer:
    """Implementation of `sgsst_core.rasterizer.Rasterizer` with blend weights that are computed once per view.

    Weights are cached in the order of the views' first use, or of the calls of `keep`, until the next weights would
    exceed `max_bytes`. Nothing is ever evicted: views are visited in rounds, so evicted weights would be needed again
    before the remaining ones.

    If a view or band has no cached weights, `cpu` or `triton` computes it in every call, on the same device. Compared
    with cached float32 weights, images are then bit-identical on the CPU and equal up to rounding on a GPU; gradients
    are equal up to rounding on both. If the weights of a whole view are cached, they serve all of its bands. Color
    gradients are reproducible bit for bit.

    Args:
        scene: Scene, whose geometry must not change during this object's lifetime.
        background: RGB color behind pixels that Gaussians leave uncovered.
        near: Near plane in world units.
        alpha_max: Upper limit of alpha.
        precision: Precision of the cached weights. `half` takes half the memory, with a relative error of at most 2^-11
            per weight.
        max_bytes: Memory budget for weights; None for no limit. On the CPU, the tile intersections of `uncached` may
            use the rest of this budget. Those of a view are dropped once the weights of the view are cached.
        least_intersection_bytes: Minimum budget for these tile intersections, regardless of the size of the weights.
        at_first_use: Whether to cache weights at first use. If False, only `keep` caches weights, and rendering other
            views does not affect later results.
        device: Device that stores and applies the weights, and on which results are returned.
        uncached: Rasterizer of the same scene that computes the weights, and renders if there are no cached weights.
            Its device, background, near plane and limit of alpha replace the arguments above. None to create one.

    Raises:
        SettingsError: If `device` is not the CPU and Triton cannot run on it.
    """

    name = "cached"
    scale = 0
    dtype = torch.float32

    def __init__(
        self,
        scene: Scene,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near: float = NEAR,
        alpha_max: float = ALPHA_MAX,
        precision: Precision = "float32",
        max_bytes: int | None = None,
        least_intersection_bytes: int = 0,
        at_first_use: bool = True,
        device: torch.device | str = "cpu",
        uncached: CpuRasterizer | TritonRasterizer | None = None,
    ) -> None:
        self.scene = scene
        self.precision: Precision = precision
        self.max_bytes = max_bytes
        self.least_intersection_bytes = least_intersection_bytes
        self._at_first_use = at_first_use
        if uncached is None and torch.device(device).type == "cpu":
            uncached = CpuRasterizer(scene, background=background, near=near, alpha_max=alpha_max)
        elif uncached is None:
            uncached = TritonRasterizer(scene, background=background, near=near, alpha_max=alpha_max, device=device)
        self.uncached = uncached
        self.device = uncached.device
        self._cached: Cache[tuple[CameraKey, Rows], _CachedBand] = Cache(max_bytes)
        self._lent: dict[tuple[CameraKey, Rows], _CachedBand] = {}
        self._lock = threading.Lock()

    @property
    def cached_bytes(self) -> int:
        """Size of all cached weights in bytes."""
        return self._cached.used

    def count(self, camera: Camera, rows: Rows | None = None) -> CountedWeights:
        """Count a band's weights without storing them; takes about as long as one render."""
        band = check_rows(camera, rows)
        if isinstance(self.uncached, CpuRasterizer):
            return CountedStrips(self.uncached, camera, band)
        return CountedPieces(self.uncached, camera, band)

    def operator_bytes(self, camera: Camera, rows: Rows | None = None) -> int:
        """Return the size in bytes that a band's cached weights would have; takes about as long as one render."""
        return self.count(camera, rows).nbytes(self.precision)

    def keep(self, camera: Camera, rows: Rows | None = None) -> bool:
        """Cache a band's weights if they fit, and return whether the band has cached weights.

        The first call for a band decides whether its weights fit; later calls do not reconsider this.
        """
        key, band = camera_key(camera), check_rows(camera, rows)
        with self._lock:
            if self._serving(key, band, camera) is None:
                self._cached.add((key, band), lambda: self._counted(camera, band))
            return self._serving(key, band, camera) is not None

    @contextmanager
    def lending(self, camera: Camera, rows: Rows | None = None) -> Iterator[None]:
        """Use temporary cached weights for a band inside a `with` block.

        If the band already has cached weights, those are used. If the weights alone would exceed `max_bytes`, they are
        not computed, and the band is rendered without them.
        """
        key, band = camera_key(camera), check_rows(camera, rows)
        counted = None if self._serving(key, band, camera) else self.count(camera, band)
        if counted is not None and (self.max_bytes is None or counted.nbytes(self.precision) <= self.max_bytes):
            self._lent[key, band] = _CachedBand(band, counted.keep(self.precision))
        try:
            yield
        finally:
            self._lent.pop((key, band), None)

    def is_cached(self, camera: Camera, rows: Rows | None = None) -> bool:
        """Return whether the band has cached weights."""
        return self._serving(camera_key(camera), check_rows(camera, rows), camera) is not None

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return the float32 image [h, width, 3] of colors [N, 3] over the background."""
        band = check_rows(camera, rows)
        values = check_colors(colors, len(self.scene), torch.float32, self.device)
        cached = self._cached_for(camera, band)
        if cached is None:
            return self.uncached.render(values, camera, band)
        return cached.weights.render(values)[band[0] - cached.band[0] : band[1] - cached.band[0]]

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return 1 - T_final, [h, width] float32 in [0, 1]: how much of each pixel the Gaussians cover."""
        band = check_rows(camera, rows)
        cached = self._cached_for(camera, band)
        if cached is None:
            return self.uncached.coverage(camera, band)
        return 1 - cached.weights.transmittance[band[0] - cached.band[0] : band[1] - cached.band[0]]

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return W^T dL/dimage, [N, 3] float32, given the image gradient [h, width, 3] of the rows."""
        band = check_rows(camera, rows)
        pixels = check_image_gradient(image_gradient, camera, band, torch.float32, self.device)
        cached = self._cached_for(camera, band)
        if cached is None:
            return self.uncached.color_gradient(pixels, camera, band)
        if cached.band != band:  # weights of the whole view: pad the gradient with zeros in all other rows
            whole = pixels.new_zeros((camera.height, camera.width, 3))
            whole[band[0] : band[1]] = pixels
            pixels = whole
        return cached.weights.color_gradient(pixels)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [height, width], and each Gaussian's blend weight summed over all pixels [N].

        Does not cache any weights.
        """
        return self.uncached.survey(camera)

    def _cached_for(self, camera: Camera, band: Rows) -> _CachedBand | None:
        """Return the cached weights for a band, or None. With `at_first_use` they are computed first, if they fit."""
        if self._at_first_use:
            self.keep(camera, band)
        return self._serving(camera_key(camera), band, camera)

    def _serving(self, key: CameraKey, band: Rows, camera: Camera) -> _CachedBand | None:
        """Return the currently cached weights that serve a band; None if there are none.

        Weights of the whole view take precedence over those of the band, and these over temporary weights.
        """
        whole = self._cached.values.get((key, (0, camera.height)))
        return whole or self._cached.values.get((key, band)) or self._lent.get((key, band))

    def _counted(self, camera: Camera, band: Rows) -> tuple[int, Callable[[], _CachedBand]]:
        """Return the size in bytes of a band's weights, and a function that computes them."""
        counted = self.count(camera, band)

        def make() -> _CachedBand:
            weights = counted.keep(self.precision)
            if self.max_bytes is not None and isinstance(self.uncached, CpuRasterizer):
                left = self.max_bytes - self.cached_bytes - weights.nbytes
                self.uncached.drop_intersections(camera, max(left, self.least_intersection_bytes))
            return _CachedBand(band, weights)

        return counted.nbytes(self.precision), make


def repeatable(rasterizer: Rasterizer) -> Rasterizer:
    """Return a rasterizer whose images are bit-identical whether or not weights are cached.

    A `CachedRasterizer` has this property only in float32 on the CPU; otherwise return the rasterizer that computes its
    weights. All other rasterizers cache no weights, and are returned unchanged.
    """
    if not isinstance(rasterizer, CachedRasterizer):
        return rasterizer
    exact = rasterizer.precision == "float32" and isinstance(rasterizer.uncached, CpuRasterizer)
    return rasterizer if exact else rasterizer.uncached
