"""`cached`: the blend weights of a view kept as a sparse operator and applied again and again.

Geometry is frozen, so a view's W never changes: an image is W c + T_final background, a gradient W^T dL/dimage, and
what is left of rasterizing is reading W from memory. Two forms of the operator:

* on the CPU, runs of weights by half raster tile (`WeightStrips`), applied with vector instructions, in the same order
  and so with the same result as `cpu`;
* on any other device, compressed sparse rows of W and of W^T (`SparseOperator`), applied by torch.
"""

from __future__ import annotations

import threading
import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.compiled import kernel_threads
from sgsst_core.constants import ALPHA_MAX, NEAR, RASTER_TILE
from sgsst_core.rasterizer import kernels
from sgsst_core.rasterizer.arguments import (
    CameraKey,
    Rows,
    camera_key,
    check_colours,
    check_image_gradient,
    check_rows,
)
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.raster_lists import RasterLists
from sgsst_core.rasterizer.vectors import as_float
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

Precision = Literal["float32", "half"]
_ITEM_BYTES = 20  # a Gaussian's index, a slot, a gradient
_PIECE_BYTES = 4  # an item


@dataclass(frozen=True)
class _Counts:
    """What a band's weights will need, counted before they are kept."""

    items: NDArray[np.int64]  # [strips]
    pieces: NDArray[np.int64]  # [4 strips], of 32 weights
    slot_items: NDArray[np.int64]  # [E], items of every (Gaussian, tile)

    def nbytes(self, pixels: int, weight_bytes: int) -> int:
        """Bytes of the operator on the CPU."""
        index = self.items.nbytes + self.pieces.nbytes + 4 * pixels + _ITEM_BYTES * int(self.items.sum())
        return index + int(self.pieces.sum()) * (_PIECE_BYTES + kernels.PIECE * weight_bytes)


def _count(lists: RasterLists, width: int, band: Rows, alpha_max: float) -> _Counts:
    """Count what a band's weights will need: costs about one render."""
    strips = (len(lists.starts) - 1) * (RASTER_TILE // kernels.STRIP)
    counts = _Counts(*(np.zeros(n, dtype=np.int64) for n in (strips, strips * kernels.BLOCKS, len(lists.ranks))))
    tiles = (lists.ranks, lists.slots, lists.starts, lists.projection.values)
    with kernel_threads():
        kernels.count_weights(*tiles, band, width, alpha_max, counts.items, counts.pieces, counts.slot_items)
    return counts


def _offsets(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts)])


class WeightStrips:
    """Blend weights of one band of a view, for the CPU.

    Weights are kept for the rows that a Gaussian reaches in a strip of 8 columns by 16 rows, one run of 8 a row,
    float32 or float16 (relative error 2^-11). See `kernels` for the layout.
    """

    def __init__(
        self, lists: RasterLists, counts: _Counts, camera: Camera, band: Rows, alpha_max: float, precision: Precision
    ) -> None:
        self.first_row = band[0]
        self.gaussians = lists.projection.gaussians
        slot_starts = _offsets(counts.slot_items)
        self.first_slots = slot_starts[lists.first_slots]
        items, pieces = int(counts.items.sum()), int(counts.pieces.sum())
        weights: NDArray[np.float32] | NDArray[np.uint16]
        if precision == "float32":
            weights = np.empty(pieces * kernels.PIECE, dtype=np.float32)
        else:
            weights = np.empty(pieces * kernels.PIECE, dtype=np.uint16)
        self.strips = kernels.Strips(
            item_starts=_offsets(counts.items),
            piece_starts=_offsets(counts.pieces),
            gaussians=np.empty(items, dtype=np.int32),
            slots=np.empty(items, dtype=np.int32),
            items=np.empty(pieces, dtype=np.int32),
            weights=weights,
        )
        self.transmittance = np.ones((band[1] - band[0], camera.width), dtype=np.float32)
        self._slot_gradients = np.empty(
            (items, 3), dtype=np.float32
        )  # used by one thread at a time: see kernel_threads
        tiles = (lists.ranks, lists.slots, lists.starts, lists.projection.values, self.gaussians)
        with kernel_threads():
            kernels.keep_weights(*tiles, band, alpha_max, slot_starts, self.strips, self.transmittance)

    def render(self, colours: NDArray[np.float32], background: NDArray[np.float32]) -> NDArray[np.float32]:
        """Image [h, width, 3] of colours [N, 3]."""
        image = np.empty((*self.transmittance.shape, 3), dtype=np.float32)
        with kernel_threads():
            kernels.apply_weights(self.strips, colours, background, self.transmittance, self.first_row, image)
        return image

    def colour_gradient(self, image_gradient: NDArray[np.float32], gaussians: int) -> NDArray[np.float32]:
        """W^T dL/dimage, [gaussians, 3], of image_gradient [h, width, 3]."""
        gradient = np.zeros((gaussians, 3), dtype=np.float32)
        with kernel_threads():
            kernels.apply_transposed_weights(self.strips, image_gradient, self.first_row, self._slot_gradients)
            kernels.add_slots(self._slot_gradients, self.first_slots, self.gaussians, gradient)
        return gradient

    def triplets(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """Nonzero weights as (pixel of the band, Gaussian, weight)."""
        weights = as_float(self.strips.weights)
        pixels, gaussians = np.empty(len(weights), dtype=np.int32), np.empty(len(weights), dtype=np.int32)
        with kernel_threads():
            kernels.locate_weights(self.strips, self.transmittance.shape[1], self.first_row, pixels, gaussians)
        inside = weights > 0
        return pixels[inside], gaussians[inside], weights[inside]


class SparseOperator:
    """Blend weights of one band of a view as torch CSR matrices W and W^T, float32, on any device."""

    def __init__(self, strips: WeightStrips, gaussians: int, device: torch.device) -> None:
        height, width = strips.transmittance.shape
        pixel, gaussian, weight = (torch.from_numpy(a).to(device) for a in strips.triplets())
        self.shape = (height, width, 3)
        self.forward = _compressed_rows(pixel, gaussian, weight, (height * width, gaussians))
        self.transposed = _compressed_rows(gaussian, pixel, weight, (gaussians, height * width))
        self.transmittance = torch.from_numpy(strips.transmittance).to(device)

    def render(self, colours: Tensor, background: Tensor) -> Tensor:
        """Image [h, width, 3] of colours [N, 3]."""
        return (self.forward @ colours).view(self.shape) + self.transmittance[..., None] * background

    def colour_gradient(self, image_gradient: Tensor) -> Tensor:
        """W^T dL/dimage, [N, 3], of image_gradient [h, width, 3]."""
        return self.transposed @ image_gradient.reshape(-1, 3)


def _compressed_rows(rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    """A float32 CSR matrix of unordered triplets (each place named once)."""
    order = torch.argsort(rows.long() * shape[1] + columns)
    counts = torch.bincount(rows, minlength=shape[0])
    index_type = torch.int32 if len(values) < 2**31 else torch.int64
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)]).to(index_type)
    with warnings.catch_warnings():  # what is used of it, matrix times matrix, works
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            starts, columns[order].to(index_type), values[order], size=shape, check_invariants=False
        )


@dataclass(frozen=True)
class _Kept:
    """An operator in memory, and the band it is good for."""

    band: Rows
    operator: WeightStrips | SparseOperator


class CachedRasterizer:
    """The protocol of `sgsst_core.rasterizer.Rasterizer` with blend weights that are computed once a view.

    Operators are kept in the order in which views first come, until the next one would exceed `max_bytes`; nothing is
    ever evicted (views come round in turn, so that what is evicted would be needed again before what is kept). Views
    and bands without a kept operator are computed by `cpu` each time, with the same result as float32 operators give. A
    band is served from the whole view's operator where that is kept, else from one of its own.

    On a device that is not the CPU, operators take two float32 CSR matrices of that device's memory, and views that do
    not fit are computed on the CPU and copied over.

    Args:
        scene: its geometry must not change while this object lives.
        background: three values added where Gaussians leave pixels uncovered.
        near: near plane in world units.
        alpha_max: clamp of alpha.
        precision: of the kept weights. `half` takes half the memory; each weight then has a relative error of at most
        2^-11.
            (Off the CPU the values are rounded through float16 but kept as float32.)
        max_bytes: memory for operators; None is no limit.
        device: where operators are kept and applied, and where results lie.
        cpu: of the same scene, whose lists, background, near plane and clamp of alpha are shared; None makes one.
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
        device: torch.device | str = "cpu",
        cpu: CpuRasterizer | None = None,
    ) -> None:
        self.scene = scene
        self.device = torch.device(device)
        self.precision: Precision = precision
        self.max_bytes = max_bytes
        self.kept_bytes = 0
        self._cpu = cpu or CpuRasterizer(scene, background=background, near=near, alpha_max=alpha_max)
        self._background = torch.as_tensor(self._cpu.background, device=self.device)
        self._kept: dict[tuple[CameraKey, Rows], _Kept | None] = {}
        self._lock = threading.Lock()

    def operator_bytes(self, camera: Camera, rows: Rows | None = None) -> int:
        """Bytes that a band's operator takes or would take. Costs about one render, and keeps nothing."""
        return self._bytes(
            _count(self._cpu.lists(camera), camera.width, check_rows(camera, rows), self._cpu.alpha_max), camera, rows
        )

    def is_kept(self, camera: Camera, rows: Rows | None = None) -> bool:
        """Whether the band is served from kept weights by now."""
        key, band = camera_key(camera), check_rows(camera, rows)
        return any(self._kept.get((key, b)) is not None for b in (band, (0, camera.height)))

    def render(self, colours: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Image [h, width, 3] float32 of colours [N, 3] in the camera's rows, over the background."""
        band = check_rows(camera, rows)
        values = check_colours(colours, len(self.scene), torch.float32, self.device)
        kept = self._operator(camera, band)
        if kept is None:
            return self._cpu.render(values, camera, band).to(self.device)
        if isinstance(kept.operator, WeightStrips):
            image = torch.from_numpy(kept.operator.render(values.numpy(), self._cpu.background))
        else:
            image = kept.operator.render(values, self._background)
        return image[band[0] - kept.band[0] : band[1] - kept.band[0]]

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """1 - T_final, [h, width] float32 in [0, 1]: how much of each pixel the Gaussians cover."""
        band = check_rows(camera, rows)
        kept = self._operator(camera, band)
        if kept is None:
            return self._cpu.coverage(camera, band).to(self.device)
        transmittance = torch.as_tensor(kept.operator.transmittance, device=self.device)
        return 1 - transmittance[band[0] - kept.band[0] : band[1] - kept.band[0]]

    def colour_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """W^T dL/dimage, [N, 3] float32, of image_gradient [h, width, 3] in the camera's rows."""
        band = check_rows(camera, rows)
        pixels = check_image_gradient(image_gradient, camera, band, torch.float32, self.device)
        kept = self._operator(camera, band)
        if kept is None:
            return self._cpu.colour_gradient(pixels, camera, band).to(self.device)
        if kept.band != band:  # the operator of the whole view: no gradient from the other rows
            whole = pixels.new_zeros((camera.height, camera.width, 3))
            whole[band[0] : band[1]] = pixels
            pixels = whole
        if isinstance(kept.operator, WeightStrips):
            return torch.from_numpy(kept.operator.colour_gradient(pixels.numpy(), len(self.scene)))
        return kept.operator.colour_gradient(pixels)

    def _operator(self, camera: Camera, band: Rows) -> _Kept | None:
        """The kept operator that serves a band, built now if it is new and fits; None where it does not fit."""
        key = camera_key(camera)
        with self._lock:
            whole = self._kept.get((key, (0, camera.height)))
            if whole is not None:
                return whole
            if (key, band) not in self._kept:
                self._kept[key, band] = self._build(camera, band)
            return self._kept[key, band]

    def _build(self, camera: Camera, band: Rows) -> _Kept | None:
        lists = self._cpu.lists(camera)
        counts = _count(lists, camera.width, band, self._cpu.alpha_max)
        size = self._bytes(counts, camera, band)
        if self.max_bytes is not None and self.kept_bytes + size > self.max_bytes:
            return None
        strips = WeightStrips(lists, counts, camera, band, self._cpu.alpha_max, self.precision)
        self.kept_bytes += size
        if self.device.type == "cpu":
            return _Kept(band, strips)
        return _Kept(band, SparseOperator(strips, len(self.scene), self.device))

    def _bytes(self, counts: _Counts, camera: Camera, rows: Rows | None) -> int:
        start, stop = check_rows(camera, rows)
        pixels = (stop - start) * camera.width
        if self.device.type == "cpu":
            return counts.nbytes(pixels, 4 if self.precision == "float32" else 2)
        # Two CSR matrices of at most so many weights (padding is dropped), 4 bytes each for value and index.
        return 2 * (int(counts.pieces.sum()) * kernels.PIECE * 8 + 4 * (pixels + len(self.scene)))
