"""Emulation of NVIDIA's TF32 on a CPU: factors are rounded to 10 mantissa bits, products are summed in float32."""

from __future__ import annotations

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

    def __init__(self, *arguments: Any, decisions: FeatureNetwork | None = None) -> None:
        super().__init__(*arguments, tf32=True)
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
