"""Triton's interpreter takes its time for every kernel: tests of something else do without some of them."""

from __future__ import annotations

import pytest

from sgsst_core.features import fused_statistics
from sgsst_core.loss import terms


def leave_out_kernels(patch: pytest.MonkeyPatch) -> None:
    """Let statistics and style loss be computed by PyTorch alone."""
    for module in (fused_statistics, terms):
        patch.setattr(module, "has_kernels", lambda device, channels: False)
