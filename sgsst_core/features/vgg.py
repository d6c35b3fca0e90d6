"""VGG feature networks as plain layers, with an explicit backward pass.

The backward is written out, not left to autograd, for three reasons: only the gradient with respect to
the pixels is wanted; saved activations are released as soon as they are used; and the discrete decisions
(ReLU masks, max-pool positions) are plain data, so that a decision that flips under rounding can be told
from an error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.features.network_sources import BLOCKS
from sgsst_core.features.network_weights import BackboneWeights

#: Layers whose Gram matrix, mean and standard deviation make up the style loss (Gatys et al.; SGSST).
STYLE_LAYERS = ("relu1_1", "relu2_1", "relu3_1", "relu4_1", "relu5_1")
#: Layer whose features make up the content loss.
CONTENT_LAYER = "relu4_2"
#: Receptive field of relu5_1 in pixels to either side (VGG19: 70, VGG16: 58), up to the next multiple of 16,
#: the stride of its cells: with this margin, features owned by a partition tile are exact.
HALO = {"vgg16": 64, "vgg19": 80}
#: Partition tiles start at multiples of the deepest layer's stride, so that every pooling window lies in one tile.
ALIGNMENT = 16


def layer_stride(layer: str) -> int:
    """Pixels from one cell of a layer to the next: 1 for relu1_*, up to 16 for relu5_*."""
    return 1 << (int(layer[4]) - 1)


FeatureGradient = Callable[[str, Tensor, Tensor], None]


@dataclass
class _Convolution:
    """A 3x3 convolution with its ReLU."""

    layer: str  # "relu1_1"
    weight: Tensor  # [out, in, 3, 3]
    bias: Tensor  # [out]
    backward_weight: Tensor  # [in, out, 3, 3], transposed and flipped


class _Pool:
    """A 2x2 max pool."""


_Step = _Convolution | _Pool


@dataclass
class Activations:
    """What one forward pass leaves behind: the features asked for and what the backward pass needs.

    Attributes:
        features: layer name to [h, w, c] in the network's dtype (a view in NHWC order).
        outputs: for each step, the ReLU's output, or the positions of a pool's maxima, [1, c, h, w].
        size: (height, width) of the pixels that went in.
    """

    features: dict[str, Tensor]
    outputs: list[Tensor] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)


def use_whole_float32() -> None:
    """Let convolutions and matrix products of float32 be float32 on GPUs too.

    PyTorch lets cuDNN round their factors to the 10 bits of TF32 unless told otherwise: gradients would no longer be
    exact, and those of a partition no longer those of the whole view.
    """
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


class FeatureNetwork:
    """VGG up to the deepest layer asked for.

    Args:
        weights: convolutions and input normalisation, in feature units of a 0-255 input.
        layers: the layers to report (for instance `STYLE_LAYERS` and `CONTENT_LAYER`); what lies behind the
            deepest of them is left out.
        dtype: torch.float32, torch.float64 (reference) or torch.bfloat16.
    """

    def __init__(
        self,
        weights: BackboneWeights,
        layers: Sequence[str] = (*STYLE_LAYERS, CONTENT_LAYER),
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        self.name = weights.name
        self.layers = tuple(layers)
        self.dtype = dtype
        self.device = torch.device(device)
        self.halo = HALO[weights.name]
        # The normalisation stays in at least float32: in bfloat16, 255 grey levels would lose their last bits twice.
        self._input_dtype = torch.promote_types(dtype, torch.float32)
        self._scale = weights.input_scale.to(self.device, self._input_dtype)
        self._shift = weights.input_shift.to(self.device, self._input_dtype)
        self._steps = self._build(weights)
        self._channels = {f"relu{name[4:]}": len(bias) for name, (_, bias) in weights.convolutions.items()}

    def _build(self, weights: BackboneWeights) -> list[_Step]:
        steps: list[_Step] = []
        left = set(self.layers)
        for block, count in enumerate(BLOCKS[weights.name], start=1):
            if block > 1:
                steps.append(_Pool())
            for index in range(1, count + 1):
                name = f"conv{block}_{index}"
                weight, bias = weights.convolutions[name]
                weight = weight.to(self.device, self.dtype)
                steps.append(
                    _Convolution(
                        f"relu{block}_{index}",
                        weight.contiguous(memory_format=torch.channels_last),
                        bias.to(self.device, self.dtype),
                        weight.transpose(0, 1).flip(2, 3).contiguous(memory_format=torch.channels_last),
                    )
                )
                left.discard(f"relu{block}_{index}")
                if not left:
                    return steps
        raise ValueError(f"{weights.name} has no layers {sorted(left)}")

    def channels(self, layer: str) -> int:
        """Number of channels of a layer."""
        return self._channels[layer]

    @torch.no_grad()
    def forward(self, rgb: Tensor, *, keep: bool = True) -> Activations:
        """Features of pixels.

        Args:
            rgb: [h, w, 3], values 0..1 (not clamped), any float dtype.
            keep: hold what `backward` needs; without it only the features asked for survive.

        Returns:
            Activations; a layer whose stride exceeds the pixels has zero cells (a dimension of size 0).
        """
        height, width = int(rgb.shape[0]), int(rgb.shape[1])
        x = rgb.to(self.device, self._input_dtype) * self._scale + self._shift
        # [h, w, 3] seen as [1, 3, h, w] is already in channels-last order: no copy.
        x = x.to(self.dtype).permute(2, 0, 1).unsqueeze(0)
        kept = Activations({}, size=(height, width))
        for step in self._steps:
            if isinstance(step, _Pool):
                if min(x.shape[2:]) < 2:
                    break
                x, positions = F.max_pool2d(x, 2, return_indices=True)
                if keep:
                    kept.outputs.append(positions)
                continue
            x = F.conv2d(x, step.weight, step.bias, padding=1).relu_()
            if keep:
                kept.outputs.append(x)
            if step.layer in self.layers:
                kept.features[step.layer] = x[0].permute(1, 2, 0)
        for layer in self.layers:
            if layer not in kept.features:
                stride = layer_stride(layer)
                kept.features[layer] = x.new_empty((height // stride, width // stride, self.channels(layer)))
        return kept

    @torch.no_grad()
    def backward(self, kept: Activations, feature_gradient: FeatureGradient) -> Tensor:
        """Gradient with respect to the pixels; consumes `kept`.

        Args:
            kept: a forward pass made with keep=True; its tensors are released on the way.
            feature_gradient: called for each reported layer, deepest first, with its name, its features [h, w, c] and
                the gradient [h, w, c] so far; adds dL/dfeatures to it in place.

        Returns:
            dL/drgb, [h, w, 3], float32 (float64 for a float64 network).
        """
        gradient: Tensor | None = None  # [1, c, h, w]
        steps = self._steps[: len(kept.outputs)]
        for step in reversed(steps):
            output = kept.outputs.pop()
            if isinstance(step, _Pool):
                gradient = self._pool_backward(gradient, output, kept)
                continue
            features = kept.features.pop(step.layer, None)
            if features is not None and features.numel():
                gradient = torch.zeros_like(output) if gradient is None else gradient
                feature_gradient(step.layer, features, gradient[0].permute(1, 2, 0))
            if gradient is not None:
                gradient = torch.ops.aten.threshold_backward(gradient, output, 0)
                gradient = F.conv2d(gradient, step.backward_weight, padding=1)
        if gradient is None:
            return torch.zeros((*kept.size, 3), dtype=self._input_dtype, device=self.device)
        return gradient[0].permute(1, 2, 0).to(self._input_dtype) * self._scale

    @staticmethod
    def _pool_backward(gradient: Tensor | None, positions: Tensor, kept: Activations) -> Tensor | None:
        if gradient is None:
            return None
        source = kept.outputs[-1]  # the ReLU output that was pooled
        spread: Tensor = torch.ops.aten.max_pool2d_with_indices_backward(
            gradient, source, [2, 2], [2, 2], [0, 0], [1, 1], False, positions
        )
        return spread

    def held_bytes_per_pixel(self) -> float:
        """Bytes that a forward pass keeps for each pixel until `backward` has used them.

        Counted from the layers: a ReLU output of c channels at stride k holds c/k^2 values a pixel, a pool one
        int64 position for each of its outputs.
        """
        size = torch.finfo(self.dtype).bits // 8
        held, stride, channels = 0.0, 1, 3
        for step in self._steps:
            if isinstance(step, _Pool):
                stride *= 2
                held += 8 * channels / stride**2
            else:
                channels = int(step.weight.shape[0])
                held += size * channels / stride**2
        return held

    def working_bytes_per_pixel(self) -> float:
        """Bytes a pixel that a forward or backward pass needs beside what is held: two tensors of relu1_1's size."""
        return 2 * self.channels("relu1_1") * torch.finfo(self.dtype).bits / 8
