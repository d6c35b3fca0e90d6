"""`cached`: rasterizer that stores the blend weights of a view and reapplies them in every step.

Geometry is frozen, so the blend weights W of a view never change: an image is W c + T_final background, the color
gradient is W^T dL/dimage, and rasterization is reduced to reading W from memory. Weights are stored on the device that
applies them, in a layout for this device.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    camera_key,
)
from sgsst_core.rasterizer.triton import TritonRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


class CachedRasterizer(Rasterizer):
    """Rasterizer whose blend weights are computed once per view by another one.

    Weights are cached in the order of the views' first use, or of the calls of `cache_weights`, until the next weights
    would exceed `max_bytes`. Nothing is ever evicted: views are visited in rounds, so evicted weights would be needed
    again before the remaining ones.

    If a view has no cached weights, `uncached` computes it in every call. Images and gradients are then equal up to
    rounding, for float32 weights. Color gradients are reproducible bit for bit.

    Args:
        scene: Scene, whose geometry must not change during this object's lifetime.
        precision: Precision of the cached weights. `half` takes half the memory, with a relative error of at most 2^-11
            per weight.
        max_bytes: Memory budget for weights; None for no limit. Tile intersections of `uncached` may use the rest.
            Those of a view are dropped once the weights of the view are cached.
        min_intersection_bytes: Minimum budget for these tile intersections, regardless of the size of the weights.
        at_first_use: Whether to cache weights at first use. If False, only `cache_weights` does, and rendering
            other views does not affect later results.
        device: Device for the default of `uncached`; None for the current GPU.
        uncached: Rasterizer of the same scene that computes the weights, and renders if there are no cached weights;
            its class must have `can_cache`. None to create `triton`.
        options: Further options of the default of `uncached`.

    Raises:
        SettingsError: If Triton cannot run on `device`.
    """

    name = "cached"
    title = "cached blend weights"

    def __init__(
        self,
        scene: Scene,
        *,
        precision: Precision = "float32",
        max_bytes: int | None = None,
        min_intersection_bytes: int = 0,
        at_first_use: bool = True,
        device: torch.device | str | None = None,
        uncached: Rasterizer | None = None,
        **options: Any,
    ) -> None:
        if uncached is None:
            uncached = TritonRasterizer(scene, device=device, **options)
        self._uncached = uncached
        self.scene, self.device, self.near = scene, uncached.device, uncached.near
        self.precision: Precision = precision
        self.max_bytes = max_bytes
        self.min_intersection_bytes = min_intersection_bytes
        self._at_first_use = at_first_use
        self._cached: Cache[CameraKey, CachedWeights] = Cache(max_bytes)
        self._temporary: dict[CameraKey, CachedWeights] = {}
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
        return self.uncached

    def count_weights(self, camera: Camera) -> CountedWeights:
        """Count a view's weights without storing them; takes about as long as one render."""
        return self.uncached.count_weights(camera)

    def cache_weights(self, camera: Camera) -> bool:
        """Cache a view's weights if they fit, and return whether the view has cached weights.

        The first call for a view decides whether its weights fit; later calls do not reconsider this.
        """
        key = camera_key(camera)
        with self._lock:
            if self._serving(key) is None:
                self._cached.add(key, lambda: self._counted(camera))
            return self._serving(key) is not None

    @property
    def caches(self) -> dict[str, Cache[CameraKey, Any]]:
        """Caches of blend weights, "weights", and those of the uncached rasterizer."""
        return {"weights": self._cached, **self.uncached.caches}

    def intersection_budget(self, weights: int) -> int | None:
        """Return the budget for tile intersections beside `weights` bytes of cached weights; None for no limit."""
        return None if self.max_bytes is None else max(self.max_bytes - weights, self.min_intersection_bytes)

    def forget_views(self) -> None:
        """Drop the weights and the tile intersections of all views."""
        self._cached.clear()
        self.uncached.forget_views()

    @contextmanager
    def temporary_weights(self, camera: Camera) -> Iterator[None]:
        """Use temporary cached weights for a view inside a `with` block.

        If the view already has cached weights, those are used. If the weights alone would exceed `max_bytes`, they are
        not computed, and the view is rendered without them.
        """
        key = camera_key(camera)
        counted = None if self._serving(key) else self.count_weights(camera)
        if counted is not None and (self.max_bytes is None or counted.nbytes(self.precision) <= self.max_bytes):
            self._temporary[key] = counted.store(self.precision)
        try:
            yield
        finally:
            self._temporary.pop(key, None)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, w], and each Gaussian's blend weight summed over all pixels [N].

        Does not cache any weights.
        """
        return self.uncached.survey(camera)

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        cached = self._cached_for(camera)
        return self.uncached.render(colors, camera) if cached is None else cached.render(colors)

    def _coverage(self, camera: Camera) -> Tensor:
        cached = self._cached_for(camera)
        return self.uncached.coverage(camera) if cached is None else 1 - cached.transmittance

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        cached = self._cached_for(camera)
        if cached is None:
            return self.uncached.color_gradient(image_gradient, camera)
        return cached.color_gradient(image_gradient)

    def _cached_for(self, camera: Camera) -> CachedWeights | None:
        """Return the cached weights for a view, or None. With `at_first_use` they are computed first, if they fit."""
        if self._at_first_use:
            self.cache_weights(camera)
        return self._serving(camera_key(camera))

    def _serving(self, key: CameraKey) -> CachedWeights | None:
        """Return the cached or temporary weights of a view; None if there are none."""
        return self._cached.values.get(key) or self._temporary.get(key)

    def _counted(self, camera: Camera) -> tuple[int, Callable[[], CachedWeights]]:
        """Return the size in bytes of a view's weights, and a function that computes them."""
        counted = self.count_weights(camera)

        def make() -> CachedWeights:
            weights = counted.store(self.precision)
            budget = self.intersection_budget(self.cached_bytes + weights.nbytes)
            if budget is not None:
                self.uncached.release_view(camera, budget)
            return weights

        return counted.nbytes(self.precision), make
