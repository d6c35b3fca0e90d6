"""Tests that compiled max pooling and its backward pass are bit-identical to PyTorch's operations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sgsst_core.features.pooling import max_pool, max_pool_backward, max_pool_backward_reference, relu_backward

DTYPES = [torch.float32, torch.float64, torch.bfloat16]
#: Even and odd sides, a single window, and less than one window.
SIZES = [(12, 10), (13, 11), (2, 2), (3, 2), (1, 5)]


def relu_output(height: int, width: int, dtype: torch.dtype, *, levels: int = 0) -> Tensor:
    """Return a synthetic ReLU output [1, 24, h, w] with memory format channels_last.

    If `levels` is not 0, values are multiplied by it and rounded to integers. If it is small, most pooling windows
    have ties, and some are all zero.
    """
    values = torch.randn((1, height, width, 24), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    if levels:
        values = (values * levels).round()
    return values.to(dtype).permute(0, 3, 1, 2).relu_()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("levels", [0, 1])
def test_max_pool_and_backward_pass_match_pytorch(size: tuple[int, int], dtype: torch.dtype, levels: int) -> None:
    source = relu_output(*size, dtype, levels=levels)
    pooled = max_pool(source)
    assert pooled.shape[2:] == (size[0] // 2, size[1] // 2)
    assert pooled.is_contiguous(memory_format=torch.channels_last)
    if not pooled.numel():
        return
    assert torch.equal(pooled, torch.nn.functional.max_pool2d(source, 2))
    gradient = torch.randn(pooled.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64).to(dtype)
    gradient = gradient.contiguous(memory_format=torch.channels_last)
    result = max_pool_backward(gradient, source)
    assert result.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(result, max_pool_backward_reference(gradient, source))


@pytest.mark.parametrize("dtype", DTYPES)
def test_negative_zeros_and_infinities_are_compared_as_numbers(dtype: torch.dtype) -> None:
    window = torch.tensor([[-0.0, 0.0], [torch.inf, 1.0]], dtype=dtype)
    source = torch.stack([window, -torch.zeros_like(window)])[None].contiguous(memory_format=torch.channels_last)
    assert torch.equal(max_pool(source), torch.tensor([torch.inf, 0.0], dtype=dtype).view(1, 2, 1, 1))
    result = max_pool_backward(torch.ones((1, 2, 1, 1), dtype=dtype), source)
    assert result.flatten().tolist() == [0, 0, 1, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_nan_is_the_maximum(dtype: torch.dtype, sign: float) -> None:
    """NaN of either sign must propagate through max pooling."""
    source = relu_output(2, 2, dtype)
    source[0, 5, 1, 0] = torch.copysign(torch.tensor(torch.nan, dtype=dtype), torch.tensor(sign, dtype=dtype))
    assert bool(torch.signbit(source[0, 5, 1, 0])) == (sign < 0)
    assert max_pool(source)[0, 5].isnan().all()
    assert int(max_pool(source).isnan().sum()) == 1


def test_non_contiguous_gradient_is_supported() -> None:
    source = relu_output(8, 8, torch.float32)
    gradient = torch.randn((1, 4, 6, 24), generator=torch.Generator().manual_seed(5)).permute(0, 3, 1, 2)[..., 1:5]
    assert torch.equal(max_pool_backward(gradient, source), max_pool_backward_reference(gradient, source))


def test_relu_backward_works_in_place() -> None:
    output = relu_output(5, 7, torch.float32)
    gradient = torch.randn(output.shape, generator=torch.Generator().manual_seed(6))
    gradient = gradient.contiguous(memory_format=torch.channels_last)
    expected = torch.where(output > 0, gradient, 0.0)
    actual = relu_backward(gradient, output)
    assert torch.equal(actual, expected)
    assert actual.data_ptr() == gradient.data_ptr()
