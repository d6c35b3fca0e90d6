"""`cached`: the blend weights of a view kept and applied again and again.

Geometry is frozen, so a view's W never changes: an image is W c + T_final background, a gradient W^T dL/dimage, and
what is left of rasterizing is reading W from memory. Weights are kept where they are applied, in a layout for the
device: `strips` on the CPU, `triton_kept` on GPUs.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

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
from sgsst_core.rasterizer.triton_kept import CountedPieces
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


@dataclass(frozen=True)
class _Kept:
    """Weights in memory, and the band they are good for."""

    band: Rows
    weights: CachedWeights


class CachedRasterizer:
    """The protocol of `sgsst_core.rasterizer.Rasterizer` with blend weights that are computed once a view.

    Weights are kept in the order in which views first come, or in which `keep` names them, until the next ones would
    exceed `max_bytes`; nothing is ever evicted (views come round in turn, so that what is evicted would be needed again
    before what is kept). Views and bands without kept weights are computed each time, on the same device, by `cpu` or
    `triton`: on the CPU with the same image as float32 weights give and gradients within rounding, on a GPU both within
    rounding. A band is served from the whole view's weights where those are kept, else from its own. Color gradients
    repeat to the bit.

    Args:
        scene: its geometry must not change while this object lives.
        background: three values added where Gaussians leave pixels uncovered.
        near: near plane in world units.
        alpha_max: clamp of alpha.
        precision: of the kept weights. `half` takes half the memory; each weight then has a relative error of at most
            2^-11.
        max_bytes: memory for weights; None is no limit. On the CPU they share it with the lists of `uncached`, which
            keeps those that weights leave room for, and lets go of a view's once its weights are kept.
        least_list_bytes: memory for these lists beside it, however much is taken by weights.
        at_first_use: keep what comes; False keeps what `keep` is called for alone, so that looks at other views in
            between, as many as there may be, change no bit of what follows.
        device: where weights are kept and applied, and where results lie.
        uncached: Rasterizer of the same scene that computes weights, and what is not kept. Its lists, device,
            background, near plane and clamp of alpha take the place of those given here; None makes one.

    Raises:
        SettingsError: Triton cannot run on `device`, which is not the CPU.
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
        least_list_bytes: int = 0,
        at_first_use: bool = True,
        device: torch.device | str = "cpu",
        uncached: CpuRasterizer | TritonRasterizer | None = None,
    ) -> None:
        self.scene = scene
        self.precision: Precision = precision
        self.max_bytes = max_bytes
        self.least_list_bytes = least_list_bytes
        self.kept_bytes = 0
        self._at_first_use = at_first_use
        if uncached is None and torch.device(device).type == "cpu":
            uncached = CpuRasterizer(scene, background=background, near=near, alpha_max=alpha_max)
        elif uncached is None:
            uncached = TritonRasterizer(scene, background=background, near=near, alpha_max=alpha_max, device=device)
        self.uncached = uncached
        self.device = uncached.device
        self._kept: dict[tuple[CameraKey, Rows], _Kept | None] = {}
        self._lent: dict[tuple[CameraKey, Rows], _Kept] = {}
        self._lock = threading.Lock()

    def count(self, camera: Camera, rows: Rows | None = None) -> CountedWeights:
        """Count a band's weights: costs about one render, and keeps nothing."""
        band = check_rows(camera, rows)
        if isinstance(self.uncached, CpuRasterizer):
            return CountedStrips(self.uncached, camera, band)
        return CountedPieces(self.uncached, camera, band)

    def operator_bytes(self, camera: Camera, rows: Rows | None = None) -> int:
        """Bytes that a band's weights take or would take. Costs about one render, and keeps nothing."""
        return self.count(camera, rows).nbytes(self.precision)

    def keep(self, camera: Camera, rows: Rows | None = None) -> bool:
        """Keep a band's weights from now on; whether they fit, which is decided when the band is first named."""
        key, band = camera_key(camera), check_rows(camera, rows)
        with self._lock:
            if self._serving(key, band, camera) is None and (key, band) not in self._kept:
                self._kept[key, band] = self._keep(camera, band)
            return self._serving(key, band, camera) is not None

    @contextmanager
    def lending(self, camera: Camera, rows: Rows | None = None) -> Iterator[None]:
        """A block in which a band is served from weights as `keep` makes them, and after which they are gone.

        Those that are kept by then serve it; those that alone exceed `max_bytes`, which `keep` never makes, do not.
        """
        key, band = camera_key(camera), check_rows(camera, rows)
        counted = None if self._serving(key, band, camera) else self.count(camera, band)
        if counted is not None and (self.max_bytes is None or counted.nbytes(self.precision) <= self.max_bytes):
            self._lent[key, band] = _Kept(band, counted.keep(self.precision))
        try:
            yield
        finally:
            self._lent.pop((key, band), None)

    def is_kept(self, camera: Camera, rows: Rows | None = None) -> bool:
        """Whether the band is served from kept weights by now."""
        return self._serving(camera_key(camera), check_rows(camera, rows), camera) is not None

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Image [h, width, 3] float32 of colors [N, 3] in the camera's rows, over the background."""
        band = check_rows(camera, rows)
        values = check_colors(colors, len(self.scene), torch.float32, self.device)
        kept = self._kept_for(camera, band)
        if kept is None:
            return self.uncached.render(values, camera, band)
        return kept.weights.render(values)[band[0] - kept.band[0] : band[1] - kept.band[0]]

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """1 - T_final, [h, width] float32 in [0, 1]: how much of each pixel the Gaussians cover."""
        band = check_rows(camera, rows)
        kept = self._kept_for(camera, band)
        if kept is None:
            return self.uncached.coverage(camera, band)
        return 1 - kept.weights.transmittance[band[0] - kept.band[0] : band[1] - kept.band[0]]

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """W^T dL/dimage, [N, 3] float32, of image_gradient [h, width, 3] in the camera's rows."""
        band = check_rows(camera, rows)
        pixels = check_image_gradient(image_gradient, camera, band, torch.float32, self.device)
        kept = self._kept_for(camera, band)
        if kept is None:
            return self.uncached.color_gradient(pixels, camera, band)
        if kept.band != band:  # the weights of the whole view: no gradient from the other rows
            whole = pixels.new_zeros((camera.height, camera.width, 3))
            whole[band[0] : band[1]] = pixels
            pixels = whole
        return kept.weights.color_gradient(pixels)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Coverage [height, width], and each Gaussian's blend weights summed over all pixels [N]; keeps nothing."""
        return self.uncached.survey(camera)

    def _kept_for(self, camera: Camera, band: Rows) -> _Kept | None:
        """The kept weights that serve a band, made now if they are to be and fit; None where there are none."""
        if self._at_first_use:
            self.keep(camera, band)
        return self._serving(camera_key(camera), band, camera)

    def _serving(self, key: CameraKey, band: Rows, camera: Camera) -> _Kept | None:
        """The weights that serve a band by now: those of the whole view, else its own."""
        whole = self._kept.get((key, (0, camera.height)))
        return whole or self._kept.get((key, band)) or self._lent.get((key, band))

    def _keep(self, camera: Camera, band: Rows) -> _Kept | None:
        counted = self.count(camera, band)
        size = counted.nbytes(self.precision)
        if self.max_bytes is not None and self.kept_bytes + size > self.max_bytes:
            return None
        weights = counted.keep(self.precision)
        self.kept_bytes += weights.nbytes
        if self.max_bytes is not None and isinstance(self.uncached, CpuRasterizer):
            self.uncached.let_go_of_lists(camera, max(self.max_bytes - self.kept_bytes, self.least_list_bytes))
        return _Kept(band, weights)


def repeatable(rasterizer: Rasterizer) -> Rasterizer:
    """What renders a rasterizer's images with the same bits whether weights are kept by then or not.

    `cached` itself only in float32 on the CPU: see there.
    """
    if not isinstance(rasterizer, CachedRasterizer):
        return rasterizer
    exact = rasterizer.precision == "float32" and isinstance(rasterizer.uncached, CpuRasterizer)
    return rasterizer if exact else rasterizer.uncached
