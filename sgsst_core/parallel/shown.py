"""Which Gaussians a view shows. All others have no gradient, so that it need not travel for them.

Geometry is frozen, and so is what a view shows: ranks agree on it at the view's first visit, and never again.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

#: Where a view shows more than this share of the Gaussians, its gradient travels as it is: picking values out and
#: putting them back would take what sending fewer saves.
DENSE_SHARE = 0.7


def gaussians_sent(shown: float, gaussians: int) -> float:
    """For how many of so many Gaussians a gradient travels, of a view that shows some of them."""
    return shown if shown <= DENSE_SHARE * gaussians else gaussians


class ShownGaussians:
    """A set of Gaussians, one bit each.

    A view's is kept for the whole job: 4 million Gaussians take 0.5 MB, where their indices would take up to 32.

    Args:
        mask: [N] bool, any device, on which the bits stay.

    Attributes:
        count: how many there are.
        total: N.
    """

    def __init__(self, mask: Tensor) -> None:
        self.total = len(mask)
        self.count = int(mask.sum())
        whole = torch.nn.functional.pad(mask.to(torch.uint8), (0, -self.total % 8))
        self._bits = (whole.view(-1, 8) << _places(mask.device)).sum(dim=1, dtype=torch.uint8)

    @staticmethod
    def nbytes(gaussians: int) -> int:
        """Bytes of a set out of so many Gaussians."""
        return -(-gaussians // 8)

    @property
    def sparse(self) -> bool:
        """Whether a gradient travels for these alone."""
        return gaussians_sent(self.count, self.total) < self.total

    def indices(self) -> Tensor:
        """[count] int64, in rising order."""
        if self._bits.device.type == "cpu":  # an order of magnitude faster there
            mask = np.unpackbits(self._bits.numpy(), count=self.total, bitorder="little")
            return torch.from_numpy(np.flatnonzero(mask))
        return self._device_indices()

    def _device_indices(self) -> Tensor:
        """`indices` on any device, for which nothing waits."""
        mask = (self._bits[:, None] >> _places(self._bits.device)).bitwise_and_(1).view(-1)[: self.total]
        return torch.nonzero_static(mask, size=self.count)[:, 0]


def _places(device: torch.device) -> Tensor:
    """Of the bits of a byte."""
    return torch.arange(8, dtype=torch.uint8, device=device)
