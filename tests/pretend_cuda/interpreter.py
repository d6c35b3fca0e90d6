"""Replacement of Triton kernels by PyTorch in tests of other code, because Triton's interpreter is slow."""

import pytest

from sgsst_core.features import layers, statistics
from sgsst_core.loss import terms as terms


def leave_out_kernels(patch: pytest.MonkeyPatch) -> None:
    """Compute statistics and style loss with PyTorch operations instead of Triton kernels."""
    for module in (layers, statistics, terms):
        patch.setattr(module, "has_kernels", lambda device, channels: False)
    patch.setattr(layers, "has_pooling_kernel", lambda source: False)
