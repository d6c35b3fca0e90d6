"""GPU version of `layer_statistics`: three launches for any size, and no temporary tensor as large as the features.

Moments are summed in float32 about a shift, the mean of some rows. The shift only has to be close to the true mean.
`statistics.layer_statistics_reference` is the float64 reference.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.features.statistics import LayerStatistics
from sgsst_core.scene.spherical_harmonics import triton_runs_on

#: Feature values per span. A span is a run of positions that is summed in float32; spans are added in float64.
SPAN_VALUES = 1 << 20
#: Minimum number of feature rows averaged for the shift.
_SHIFT_ROWS = 64
#: Channels, positions and spans per step of a program.
TILE, POSITIONS, SPANS = 64, 32, 4
#: Matrix entries per program, rounded to whole rows.
ENTRIES = 1024
#: Minimum channels per block, as required for matrix products. Layers with fewer channels fill part of a block.
LEAST_CHANNELS = 16


def matrix_precision(dtype: torch.dtype) -> str:
    """Return Triton's input precision for matrix products with features of a dtype.

    TF32 suffices for bfloat16: its 11-bit significand holds the 8 bits of bfloat16.
    """
    return "tf32" if dtype == torch.bfloat16 else "ieee"


def block_of_positions(usual: int) -> int:
    """Return the number of positions per step of a program: `usual`, or more in Triton's interpreter."""
    return 4096 if _is_interpreted() else usual


def block_of_entries(channels: int) -> int:
    """Return the number of matrix entries per program, in whole rows."""
    channels = max(channels, LEAST_CHANNELS)
    return min(channels**2, 1 << 18 if _is_interpreted() else max(ENTRIES, channels))


def block_of_channels(channels: int, most: int | None = None) -> int:
    """Return the number of channels per step: all of them, or at most `most`."""
    return min(max(channels, LEAST_CHANNELS), most or max(channels, LEAST_CHANNELS))


def _is_interpreted() -> bool:
    """Return whether Triton runs in its interpreter.

    The time of an operation in the interpreter hardly depends on its size, so large blocks are best.
    """
    import triton

    return bool(triton.knobs.runtime.interpret)


def fused_statistics(features: Tensor, position_weights: Tensor | None = None) -> LayerStatistics:
    """Compute the statistics of features [h, w, c] on a GPU, with optional position weights [h, w] >= 0.

    Features are float32 or bfloat16 with contiguous channels, and c is below 16 or a power of two.
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
    """Return whether there are kernels for features [h, w, c].

    The kernels need a supported GPU, contiguous channels and a dtype other than float64.
    """
    side_by_side = features.stride(2) == 1 and features.dtype != torch.float64
    return side_by_side and has_kernels(features.device, int(features.shape[2]))


def has_kernels(device: torch.device, channels: int) -> bool:
    """Return whether there are kernels on a device for layers with this number of channels."""
    taken = channels < LEAST_CHANNELS or channels.bit_count() == 1
    return device.type == "cuda" and taken and triton_runs_on(device)
