"""`layer_statistics` on a GPU in three launches, whatever the size: nothing as large as the features is made.

The shift, about which moments are summed in float32, is the mean of some of the rows: it only has to lie near the mean.
`statistics.layer_statistics_reference` is the float64 twin.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.scene.spherical_harmonics import triton_runs_on

#: Entries that are summed in float32 before float64 takes over, for each channel.
SPAN_VALUES = 1 << 20
#: Rows of features that the shift is the mean of, at least.
_SHIFT_ROWS = 64
#: Channels, positions and spans that a program takes at a time.
TILE, POSITIONS, SPANS = 64, 32, 4
#: Entries of a layer's matrix, in whole rows, that a program takes at a time.
ENTRIES = 1024
#: Channels of a block at least: a matrix product takes no fewer. A layer of less fills a part of it.
LEAST_CHANNELS = 16


def matrix_precision(dtype: torch.dtype) -> str:
    """How Triton multiplies matrices that hold features: bfloat16's 8 bits lose nothing to the 11 of TF32."""
    return "tf32" if dtype == torch.bfloat16 else "ieee"


def block_of_positions(usual: int) -> int:
    """Positions that a program takes at a time."""
    return 4096 if _is_interpreted() else usual


def block_of_entries(channels: int) -> int:
    """Entries of a layer's matrix, in whole rows, that a program takes at a time."""
    channels = max(channels, LEAST_CHANNELS)
    return min(channels**2, 1 << 18 if _is_interpreted() else max(ENTRIES, channels))


def block_of_channels(channels: int, most: int | None = None) -> int:
    """Channels that a program takes at a time, of a layer's so many; all of them, unless it takes fewer at most."""
    return min(max(channels, LEAST_CHANNELS), most or max(channels, LEAST_CHANNELS))


def _is_interpreted() -> bool:
    """Whether Triton interprets its kernels: it takes its time for every operation, however large, so few are best."""
    import triton

    return bool(triton.knobs.runtime.interpret)


def fused_statistics(features: Tensor, position_weights: Tensor | None = None) -> LayerStatistics:
    """Statistics of features [h, w, c], float32 or bfloat16, with optional position weights [h, w] >= 0.

    c is less than 16 or a power of two, and channels lie side by side in memory.
    """
    from sgsst_core.features import fused_kernels as kernels

    height, width, channels = features.shape
    device, positions = features.device, height * width
    span = SPAN_VALUES // channels
    spans = -(-positions // span)
    tile = block_of_channels(channels, TILE)
    shift = features[:: max(1, height // _SHIFT_ROWS)].mean(dim=(0, 1), dtype=torch.float32)
    counts = torch.empty(spans, device=device)
    firsts = torch.empty((spans, channels), device=device)
    seconds = torch.empty((spans, channels, channels), device=device)
    weights = features if position_weights is None else position_weights
    kernels.shifted_moments[(spans, (-(-channels // tile)) ** 2)](
        features, weights, shift, counts, firsts, seconds,
        positions, width, *features.stride()[:2], *weights.stride()[:2],
        CHANNELS=channels, TILE=tile, SPAN=span, P=block_of_positions(POSITIONS), WEIGHTED=position_weights is not None,
        PRECISION=matrix_precision(features.dtype),
    )  # fmt: skip
    count = torch.empty((), dtype=torch.float64, device=device)
    mean = torch.empty(channels, dtype=torch.float64, device=device)
    centered = torch.empty((channels, channels), dtype=torch.float64, device=device)
    entries = block_of_entries(channels)
    kernels.add_moments[(-(-(channels**2) // entries),)](
        counts, firsts, seconds, shift, count, mean, centered, spans,
        CHANNELS=channels, ENTRIES=entries, S=SPANS,
    )  # fmt: skip
    return LayerStatistics(count, mean, centered)


def can_be_fused(features: Tensor) -> bool:
    """Whether Triton computes with features [h, w, c]: on GPUs where it works, in the layout of channels last."""
    side_by_side = features.stride(2) == 1 and features.dtype != torch.float64
    return side_by_side and has_kernels(features.device, int(features.shape[2]))


def has_kernels(device: torch.device, channels: int) -> bool:
    """Whether there are kernels for layers of so many channels on a device."""
    taken = channels < LEAST_CHANNELS or channels.bit_count() == 1
    return device.type == "cuda" and taken and triton_runs_on(device)
