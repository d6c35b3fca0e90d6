"""`cached`: rasterizer that stores the blend weights of a view and reapplies them in every step.

Geometry is frozen, so the blend weights W of a view never change: an image is W c + T_final background, the color
gradient is W^T dL/dimage, and rasterization is reduced to reading W from memory. Weights are stored on the device that
applies them, in a layout for this device: `cpu_cached` on the CPU, `triton_cached` on GPUs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.rasterizer.base import (
    CachedWeights,
    CameraKey,
    CountedWeights,
    Precision,
    Rasterizer,
    RenderCost,
    Rows,
    camera_key,
    check_rows,
)
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


@dataclass(frozen=True)
class _CachedBand:
    """Cached weights of a band of rows."""

    band: Rows
    weights: CachedWeights


class CachedRasterizer(Rasterizer):
    """Rasterizer whose blend weights are computed once per view by another one.

    Weights are cached in the order of the views' first use, or of the calls of `cache_weights`, until the next weights
    would exceed `max_bytes`. Nothing is ever evicted: views are visited in rounds, so evicted weights would be needed
    again before the remaining ones.

    If a view or band has no cached weights, `uncached` computes it in every call. Compared with cached float32 weights,
    images are then bit-identical on the CPU and equal up to rounding on a GPU; gradients are equal up to rounding on
    both. If the weights of a whole view are cached, they serve all of its bands. Color gradients are reproducible bit
    for bit.

    Args:
        scene: Scene, whose geometry must not change during this object's lifetime.
        precision: Precision of the cached weights. `half` takes half the memory, with a relative error of at most 2^-11
            per weight.
        max_bytes: Memory budget for weights; None for no limit. On the CPU, the tile intersections of `uncached` may
            use the rest of this budget. Those of a view are dropped once the weights of the view are cached.
        least_intersection_bytes: Minimum budget for these tile intersections, regardless of the size of the weights.
        at_first_use: Whether to cache weights at first use. If False, only `cache_weights` does, and rendering
            other views does not affect later results.
        device: Device for the default of `uncached`; None for the CPU.
        uncached: Rasterizer of the same scene that computes the weights, and renders if there are no cached weights;
            its class must have `can_cache`. None to create `cpu` or, on a GPU, `triton`.
        options: Further options of the default of `uncached`.

    Raises:
        SettingsError: If `device` is not the CPU and Triton cannot run on it.
    """

    name = "cached"
    title = "cached blend weights"

    def __init__(
        self,
        scene: Scene,
        *,
        precision: Precision = "float32",
        max_bytes: int | None = None,
        least_intersection_bytes: int = 0,
        at_first_use: bool = True,
        device: torch.device | str | None = None,
        uncached: Rasterizer | None = None,
        **options: Any,
    ) -> None:
        if uncached is None:
            kind = CpuRasterizer if torch.device(device or "cpu").type == "cpu" else TritonRasterizer
            uncached = kind(scene, device=device, **options)
        self._uncached = uncached
        self.scene, self.device, self.near = scene, uncached.device, uncached.near
        self.precision: Precision = precision
        self.max_bytes = max_bytes
        self.least_intersection_bytes = least_intersection_bytes
        self._at_first_use = at_first_use
        self._cached: Cache[tuple[CameraKey, Rows], _CachedBand] = Cache(max_bytes)
        self._temporary: dict[tuple[CameraKey, Rows], _CachedBand] = {}
        self._lock = threading.Lock()

    @classmethod
    def options(cls, memory: int) -> dict[str, Any]:
        """Return constructor options for a memory budget in bytes."""
        return {"max_bytes": memory}

    @property
    def cached_bytes(self) -> int:
        """Size of all cached weights in bytes."""
        return self._cached.used

    @property
    def uncached(self) -> Rasterizer:
        """Rasterizer that computes blend weights in every call."""
        return self._uncached

    @property
    def repeatable(self) -> Rasterizer:
        """Rasterizer whose images are bit-identical whether or not weights are cached."""
        exact = self.precision == "float32" and self.uncached.caches_exactly
        return self if exact else self.uncached

    def count_weights(self, camera: Camera, rows: Rows | None = None) -> CountedWeights:
        """Count a band's weights without storing them; takes about as long as one render."""
        return self.uncached.count_weights(camera, rows)

    def cache_weights(self, camera: Camera, rows: Rows | None = None) -> bool:
        """Cache a band's weights if they fit, and return whether the band has cached weights.

        The first call for a band decides whether its weights fit; later calls do not reconsider this.
        """
        key, band = camera_key(camera), check_rows(camera, rows)
        with self._lock:
            if self._serving(key, band, camera) is None:
                self._cached.add((key, band), lambda: self._counted(camera, band))
            return self._serving(key, band, camera) is not None

    @contextmanager
    def temporary_weights(self, camera: Camera, rows: Rows | None = None) -> Iterator[None]:
        """Use temporary cached weights for a band inside a `with` block.

        If the band already has cached weights, those are used. If the weights alone would exceed `max_bytes`, they are
        not computed, and the band is rendered without them.
        """
        key, band = camera_key(camera), check_rows(camera, rows)
        counted = None if self._serving(key, band, camera) else self.count_weights(camera, band)
        if counted is not None and (self.max_bytes is None or counted.nbytes(self.precision) <= self.max_bytes):
            self._temporary[key, band] = _CachedBand(band, counted.store(self.precision))
        try:
            yield
        finally:
            self._temporary.pop((key, band), None)

    def is_cached(self, camera: Camera, rows: Rows | None = None) -> bool:
        """Return whether the band has cached weights."""
        return self._serving(camera_key(camera), check_rows(camera, rows), camera) is not None

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, width] of the whole view, and each Gaussian's blend weight summed over all pixels [N].

        Does not cache any weights.
        """
        return self.uncached.survey(camera)

    def probe_cost(self, cameras: Sequence[Camera]) -> RenderCost:
        """Measure the cost of rendering some views with gradient without cached weights."""
        return self.uncached.probe_cost(cameras)

    def _render(self, colors: Tensor, camera: Camera, band: Rows) -> Tensor:
        cached = self._cached_for(camera, band)
        if cached is None:
            return self.uncached.render(colors, camera, band)
        return cached.weights.render(colors)[band[0] - cached.band[0] : band[1] - cached.band[0]]

    def _coverage(self, camera: Camera, band: Rows) -> Tensor:
        cached = self._cached_for(camera, band)
        if cached is None:
            return self.uncached.coverage(camera, band)
        return 1 - cached.weights.transmittance[band[0] - cached.band[0] : band[1] - cached.band[0]]

    def _color_gradient(self, image_gradient: Tensor, camera: Camera, band: Rows) -> Tensor:
        cached = self._cached_for(camera, band)
        if cached is None:
            return self.uncached.color_gradient(image_gradient, camera, band)
        if cached.band != band:  # weights of the whole view: pad the gradient with zeros in all other rows
            whole = image_gradient.new_zeros((camera.height, camera.width, 3))
            whole[band[0] : band[1]] = image_gradient
            image_gradient = whole
        return cached.weights.color_gradient(image_gradient)

    def _cached_for(self, camera: Camera, band: Rows) -> _CachedBand | None:
        """Return the cached weights for a band, or None. With `at_first_use` they are computed first, if they fit."""
        if self._at_first_use:
            self.cache_weights(camera, band)
        return self._serving(camera_key(camera), band, camera)

    def _serving(self, key: CameraKey, band: Rows, camera: Camera) -> _CachedBand | None:
        """Return the currently cached weights that serve a band; None if there are none.

        Weights of the whole view take precedence over those of the band, and these over temporary weights.
        """
        whole = self._cached.values.get((key, (0, camera.height)))
        return whole or self._cached.values.get((key, band)) or self._temporary.get((key, band))

    def _counted(self, camera: Camera, band: Rows) -> tuple[int, Callable[[], _CachedBand]]:
        """Return the size in bytes of a band's weights, and a function that computes them."""
        counted = self.count_weights(camera, band)

        def make() -> _CachedBand:
            weights = counted.store(self.precision)
            if self.max_bytes is not None:
                left = self.max_bytes - self.cached_bytes - weights.nbytes
                self.uncached.release_view(camera, max(left, self.least_intersection_bytes))
            return _CachedBand(band, weights)

        return counted.nbytes(self.precision), make
