"""Sets of the Gaussians that a view shows; only their gradients need to be exchanged.

Geometry is frozen, so the set of a view never changes. Ranks agree on it at their first visit of the view.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

#: If a view shows more than this fraction of all Gaussians, the whole gradient is sent: gathering and scattering values
#: would take more time than sending fewer values saves.
DENSE_FRACTION = 0.7


def gaussians_sent(shown: float, gaussians: int) -> float:
    """Return the number of Gaussians whose gradients are sent for a view that shows `shown` of them."""
    return shown if shown <= DENSE_FRACTION * gaussians else gaussians


class ShownGaussians:
    """Set of Gaussians, one bit each.

    Each view's set is stored for the whole job: 4 million Gaussians take 0.5 MB, while their indices would take up to
    32 MB.

    Args:
        mask: [N] bool, on any device; the bits are stored on the same device.
    """

    def __init__(self, mask: Tensor) -> None:
        self.total = len(mask)
        self.count = int(mask.sum())
        whole = torch.nn.functional.pad(mask.to(torch.uint8), (0, -self.total % 8))
        self._bits = (whole.view(-1, 8) << _bit_positions(mask.device)).sum(dim=1, dtype=torch.uint8)

    @staticmethod
    def nbytes(gaussians: int) -> int:
        """Return the size in bytes of a set, for a scene with this many Gaussians."""
        return -(-gaussians // 8)

    @property
    def sparse(self) -> bool:
        """Whether only the gradients of Gaussians in the set are sent, instead of all gradients."""
        return gaussians_sent(self.count, self.total) < self.total

    def indices(self) -> Tensor:
        """Return the indices [count] int64 in ascending order."""
        if self._bits.device.type == "cpu":  # on a CPU, NumPy is an order of magnitude faster
            mask = np.unpackbits(self._bits.numpy(), count=self.total, bitorder="little")
            return torch.from_numpy(np.flatnonzero(mask))
        return self._device_indices()

    def _device_indices(self) -> Tensor:
        """Compute `indices` on any device without synchronizing with it."""
        mask = (self._bits[:, None] >> _bit_positions(self._bits.device)).bitwise_and_(1).view(-1)[: self.total]
        return torch.nonzero_static(mask, size=self.count)[:, 0]


def _bit_positions(device: torch.device) -> Tensor:
    """Return the positions of the bits in a byte."""
    return torch.arange(8, dtype=torch.uint8, device=device)
