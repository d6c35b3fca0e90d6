"""Adam on the DC colors, guarded against gradients that it cannot square."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim.adam import adam

from sgsst_core.scene.luminance import with_chroma_of
from sgsst_core.scene.screen import on_screen, on_screen_by_luminance

#: Adam's epsilon: as good as none, so that Gaussians of any blend weight move at the learning rate (SGSST).
ADAM_EPS = 1e-15
#: Decay of the first and the second moment, the usual ones.
_BETA1, _BETA2 = 0.9, 0.999
#: Adam squares gradients in float32. Beyond this a square is infinite and its value would never move again, silently.
LARGEST_GRADIENT = 1e19


class ColorOptimizer:
    """Adam (Kingma and Ba 2015) on one tensor of colors.

    On a GPU a step is one kernel, which looks itself whether it is to be made: the host need not wait to be told.

    The steps are PyTorch's function `adam`. Its class `Adam` makes the same ones, and imports PyTorch's compiler on the
    way: two seconds of every process that optimizes, and nothing here is compiled.

    Args:
        colors: [n, 3] float32, changed in place.
        unit: of the features that gradients come from (`FeatureNetwork.unit`). Adam's steps do not depend on it, but
            gradients grow with its square, and would sooner be too large to be squared.
        chroma_of: [n, 3], colors whose chroma is kept: what is optimized is then how far each color's luminance is
            from theirs. None lets colors change freely.
        bounded: bring colors back into 0..1 after each step (`scene.screen`).
        kept: [n, 1], those that stay as they are, whose gradients are 0. None where there are none.
    """

    def __init__(
        self,
        colors: Tensor,
        unit: float = 1.0,
        chroma_of: Tensor | None = None,
        *,
        bounded: bool = False,
        kept: Tensor | None = None,
    ) -> None:
        self._chroma_of = chroma_of
        self._bounded, self._kept = bounded, kept
        self._colors = colors.requires_grad_()
        self._unit = unit
        self._fused = colors.is_cuda
        self._first, self._second = (torch.zeros_like(colors, requires_grad=False) for _ in range(2))
        self._steps = torch.zeros((), dtype=torch.float32, device=colors.device if self._fused else None)

    def update(self, gradient: Tensor, learning_rate: float) -> Tensor:
        """One step, but for a gradient [n, 3] that is beyond `LARGEST_GRADIENT` or not finite: then nothing changes.

        Returns:
            The largest magnitude in the gradient, in units of a 0-255 input: a scalar on the colors' device. The
            caller looks whether it was too large, when it next waits for the device anyway.
        """
        if self._unit != 1:
            gradient = gradient / self._unit**2
        if self._chroma_of is not None:
            # The derivative with respect to what is added to all three channels. Adam's steps are the same in each.
            gradient = gradient.sum(dim=1, keepdim=True).expand(-1, 3).contiguous()
        largest = gradient.abs().amax()
        self._colors.grad = gradient.to(self._colors.dtype)
        if self._fused:
            # PyTorch's way to tell a fused step that its gradient cannot be used, made for scaled half precision.
            self._step(learning_rate, torch.logical_not(largest <= LARGEST_GRADIENT).float())
        elif not is_too_large(float(largest)):
            self._step(learning_rate)
        else:
            return largest
        self._constrain(largest)
        return largest

    @torch.no_grad()
    def _step(self, learning_rate: float, found_inf: Tensor | None = None) -> None:
        """Where `found_inf` is not 0, nothing changes."""
        assert self._colors.grad is not None
        adam(
            [self._colors],
            [self._colors.grad],
            [self._first],
            [self._second],
            [],
            [self._steps],
            fused=self._fused,
            found_inf=found_inf,
            amsgrad=False,
            beta1=_BETA1,
            beta2=_BETA2,
            lr=learning_rate,
            weight_decay=0.0,
            eps=ADAM_EPS,
            maximize=False,
        )

    @torch.no_grad()
    def _constrain(self, largest: Tensor) -> None:
        """Bring colors back to where they may be: within the bounds, with their chroma.

        Where no step was made, and of kept Gaussians, nothing changes.
        """
        if not self._bounded and self._chroma_of is None:
            return
        found = constrained(self._colors, self._chroma_of, bounded=self._bounded)
        unchanged = ~(largest <= LARGEST_GRADIENT)
        if self._kept is not None:
            unchanged = unchanged | self._kept
        self._colors.copy_(torch.where(unchanged, self._colors, found))

    def moments(self) -> tuple[Tensor, Tensor]:
        """First and second moment [n, 3], on the CPU; zeros before the first step."""
        return self._first.cpu().clone(), self._second.cpu().clone()

    def load_moments(self, step: int, first: Tensor, second: Tensor) -> None:
        """Go on after so many steps, at least one, with their moments [n, 3]."""
        self._steps.fill_(step)
        self._first.copy_(first)
        self._second.copy_(second)


def constrained(colors: Tensor, chroma_of: Tensor | None, *, bounded: bool) -> Tensor:
    """DC coefficients [n, 3], brought into the bounds where there are some, without rounding of their chroma.

    Args:
        colors: [n, 3].
        chroma_of: [n, 3], colors that they differ from in luminance alone; None where they may in anything.
        bounded: whether colors stay in 0..1.
    """
    if chroma_of is None:
        return on_screen(colors) if bounded else colors
    return with_chroma_of(on_screen_by_luminance(colors) if bounded else colors, chroma_of)


def is_too_large(largest: float) -> bool:
    """Whether a gradient of that largest magnitude (NaN included) cannot be used."""
    return not largest <= LARGEST_GRADIENT
