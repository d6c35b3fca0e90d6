"""Tests of sets of Gaussians, which are stored as bit masks."""

from __future__ import annotations

import pytest
import torch

from sgsst_core.parallel.collectives import DENSE_FRACTION, ShownGaussians, gaussians_sent


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("gaussians", [0, 1, 7, 8, 9, 1001])
def test_set_contains_the_gaussians_of_its_mask(gaussians: int, share: float) -> None:
    mask = torch.rand(gaussians, generator=torch.Generator().manual_seed(gaussians)) < share
    shown = ShownGaussians(mask)
    for indices in (shown.indices(), shown._device_indices()):
        assert torch.equal(indices, mask.nonzero()[:, 0])
    assert (shown.count, shown.total) == (int(mask.sum()), gaussians)
    assert shown._bits.nbytes == ShownGaussians.nbytes(gaussians)


def test_whole_gradient_is_sent_if_nearly_all_are_shown() -> None:
    assert gaussians_sent(300, 1000) == 300
    assert gaussians_sent(DENSE_FRACTION * 1000 + 1, 1000) == 1000
    assert gaussians_sent(2000, 1000) == 1000, "a survey counts pruned ones too"
    mask = torch.arange(1000) < 600
    assert ShownGaussians(mask).sparse
    assert not ShownGaussians(torch.roll(mask, 500) | mask).sparse
    assert not ShownGaussians(mask[:0]).sparse
