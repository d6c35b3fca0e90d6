"""First convolution of the feature network on a GPU, from pixels to 16-bit features, and its backward pass.

One kernel each also does what surrounds the convolution: normalization, bias, ReLU, and the factor of the pixels.
`FeatureNetwork` contains the references: it does the same with PyTorch operations where there are no kernels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.devices import on_device
from sgsst_core.features import statistics


def has_kernels(weight: Tensor) -> bool:
    """Return whether there are kernels for weights [c, 3, 3, 3] of the first convolution, or their transpose."""
    channels = max(weight.shape[:2])
    return weight.element_size() == 2 and statistics.has_kernels(weight.device, channels)


def convolve_pixels(pixels: Tensor, weight: Tensor, bias: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """Return relu(convolution(scale * pixels + shift) + bias), [1, c, h, w], channels last.

    Args:
        pixels: [h, w, 3] float32.
        weight: [c, 3, 3, 3], channels last, bfloat16 or float16.
        scale, shift: [3] float32.
    """
    from sgsst_core.features import first_layer_kernels as kernels

    (height, width, _), channels, strip = pixels.shape, len(weight), kernels.P.value
    out = torch.empty((height, width, channels), dtype=weight.dtype, device=pixels.device)
    with on_device(pixels.device):
        kernels.convolve_pixels[(height * -(-width // strip),)](
            pixels.contiguous(), weight, bias, scale, shift, out, height, width,
            CHANNELS=channels, BLOCK=statistics.block_of_channels(channels), P=strip,
        )  # fmt: skip
    return out.permute(2, 0, 1).unsqueeze(0)


def pixel_gradient(gradient: Tensor, backward_weight: Tensor, scale: Tensor) -> Tensor:
    """Return the gradient of the pixels [h, w, 3] float32.

    Args:
        gradient: Gradient of the convolution's output before its ReLU, [1, c, h, w], channels last.
        backward_weight: Transposed and flipped weights [3, c, 3, 3], channels last.
        scale: [3] float32.
    """
    from sgsst_core.features import first_layer_kernels as kernels

    cells, strip = gradient[0].permute(1, 2, 0).contiguous(), kernels.P.value
    height, width, channels = cells.shape
    out = torch.empty((3, height, width, 3), device=cells.device)
    with on_device(cells.device):
        kernels.pixel_gradients[((height + 2) * -(-width // strip),)](
            cells, backward_weight, scale, out, height, width,
            CHANNELS=channels, BLOCK=statistics.block_of_channels(channels), P=strip,
        )  # fmt: skip
    return out.sum(dim=0)
