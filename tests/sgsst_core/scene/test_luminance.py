from __future__ import annotations

import pytest
import torch

from sgsst_core.scene.colors import WEIGHTS, gray, gray_gradient, luminance, with_chroma_of


def colors(count: int = 200, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


def test_gray_keeps_luminance_and_has_no_chroma() -> None:
    grays = gray(colors())
    assert sum(WEIGHTS) == pytest.approx(1, abs=1e-15)
    torch.testing.assert_close(grays[:, 0], colors() @ torch.tensor(WEIGHTS, dtype=torch.float64))
    assert torch.equal(grays[:, 0], grays[:, 1])
    assert torch.equal(grays[:, 0], grays[:, 2])
    torch.testing.assert_close(luminance(grays), grays[:, 0])
    assert grays.is_contiguous()


def test_gray_gradient_agrees_with_autograd() -> None:
    values, sent = colors().requires_grad_(), colors(200).flip(0)
    (wanted,) = torch.autograd.grad((gray(values) * sent).sum(), values)
    torch.testing.assert_close(gray_gradient(sent), wanted)


def test_chroma_comes_from_the_original() -> None:
    original = 3 * colors(dtype=torch.float32)
    shift = torch.linspace(-5, 5, 200)[:, None]
    noise = 1e-3 * colors(dtype=torch.float32).flip(0)
    result = with_chroma_of(original + shift + noise, original)
    change = result.double() - original.double()
    largest = torch.maximum(result.abs(), original.abs()).amax()
    assert float((change - change.mean(1, keepdim=True)).abs().max()) <= float(largest) * 2**-23
    torch.testing.assert_close(change.mean(1), (shift[:, 0] + noise.mean(1)).double(), rtol=0, atol=1e-5)


def test_chroma_errors_do_not_accumulate() -> None:
    original = colors(dtype=torch.float32)
    present = original
    for _ in range(2000):
        present = with_chroma_of(present + 1e-3, original)
    change = present.double() - original.double()
    assert float((change - change[:, :1]).abs().max()) < 1e-6
