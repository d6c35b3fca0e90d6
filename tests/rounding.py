"""Emulation of a GPU's TF32 and float16 on a CPU: factors are rounded, products are summed in float32."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sgsst_core.features import vgg
from sgsst_core.features.vgg import Activations, FeatureNetwork

#: Bits of float32's significand that TF32 lacks.
_LOST = 13


def to_tf32(values: Tensor) -> Tensor:
    """Round float32 values to 10 mantissa bits, to nearest, ties to even."""
    bits = values.view(torch.int32)
    half_and_tie = (1 << _LOST - 1) - 1 + (bits >> _LOST & 1)
    return (bits + half_and_tie & ~((1 << _LOST) - 1)).view(torch.float32)


class RoundedToTf32(FeatureNetwork):
    """Float32 network whose convolutions round their factors to TF32.

    Args:
        decisions: Network whose ReLU masks and max pooling positions are used in the backward pass; None to use those
            of the rounded network itself.
    """

    def __init__(self, *arguments: Any, decisions: FeatureNetwork | None = None, tf32: bool = True) -> None:
        super().__init__(*arguments, tf32=tf32)
        self._decisions = decisions

    def forward(self, rgb: Tensor, *, cache: bool = True, until: str | None = None) -> Activations:
        activations = super().forward(rgb, cache=cache, until=until)
        if self._decisions:
            activations.outputs = self._decisions.forward(rgb, cache=cache, until=until).outputs
        return activations

    def _convolve(self, x: Tensor, step: vgg._Convolution) -> Tensor:
        return super()._convolve(to_tf32(x), replace(step, weight=to_tf32(step.weight)))

    def _convolve_back(self, gradient: Tensor, step: vgg._Convolution) -> Tensor:
        return super()._convolve_back(to_tf32(gradient), replace(step, backward_weight=to_tf32(step.backward_weight)))


class RoundedToFloat16(FeatureNetwork):
    """Float32 network that rounds weights, features and gradients as one in float16 does, with the same powers of two.

    Attributes:
        feature_unit: Feature that float16 holds as 1.
        gradient_unit: Gradient with respect to a feature that float16 holds as 1.
    """

    feature_unit, gradient_unit = 2.0**6, 2.0**16

    def _convolve(self, x: Tensor, step: vgg._Convolution) -> Tensor:
        unit = self.feature_unit
        rounded = replace(step, weight=to_float16(step.weight), bias=to_float16(step.bias, unit))
        return to_float16(super()._convolve(to_float16(x, unit), rounded), unit)

    def _convolve_back(self, gradient: Tensor, step: vgg._Convolution) -> Tensor:
        unit = self.gradient_unit
        rounded = replace(step, backward_weight=to_float16(step.backward_weight))
        return to_float16(super()._convolve_back(to_float16(gradient, unit), rounded), unit)


def to_float16(values: Tensor, unit: float = 1.0) -> Tensor:
    """Round float32 values, divided by a unit, to float16."""
    return (values / unit).half().float() * unit
