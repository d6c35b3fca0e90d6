"""Adam for DC colors, with protection against gradients that overflow when squared."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim.adam import adam

from sgsst_core.scene.colors import ColorSubspace, on_screen, on_screen_by_luminance, with_chroma_of

#: Adam's epsilon: practically zero, so that Gaussians of any blend weight move at the learning rate (SGSST).
ADAM_EPS = 1e-15
#: Decay rates of the first and second moment, the usual ones.
_BETA1, _BETA2 = 0.9, 0.999
#: Adam squares gradients in float32. Beyond this limit the square is infinite, and the value would silently stop
#: moving.
LARGEST_GRADIENT = 1e19


class ColorOptimizer:
    """Adam (Kingma and Ba 2015) for a single tensor of colors.

    On a GPU, a step is one kernel that checks by itself whether the gradient is usable, so the host need not
    synchronize.

    Steps use PyTorch's function `adam`. Its class `Adam` gives the same steps but imports PyTorch's compiler, which
    takes two seconds per process although nothing is compiled here.

    Args:
        colors: [n, 3] float32, updated in place.
        unit: Unit of the features behind the gradients (`FeatureNetwork.unit`). Adam's steps do not depend on it, but
            gradients grow with its square and would overflow earlier.
        chroma_of: [n, 3], colors whose chroma is preserved: the optimized quantity is then each color's difference from
            them in luminance. None to let colors change freely.
        subspace: Color subspace that colors stay in; None to let them change freely.
        bounded: Whether to project colors to 0..1 after each step (`on_screen`).
        frozen: [n, 1] bool, frozen colors, whose gradients are 0; None if there are none.
    """

    def __init__(
        self,
        colors: Tensor,
        unit: float = 1.0,
        chroma_of: Tensor | None = None,
        subspace: ColorSubspace | None = None,
        *,
        bounded: bool = False,
        frozen: Tensor | None = None,
    ) -> None:
        self._chroma_of, self._subspace = chroma_of, subspace
        self._bounded, self._frozen = bounded, frozen
        self._colors = colors.requires_grad_()
        self._unit = unit
        self._fused = colors.is_cuda
        self._first, self._second = (torch.zeros_like(colors, requires_grad=False) for _ in range(2))
        self._steps = torch.zeros((), dtype=torch.float32, device=colors.device if self._fused else None)

    def update(self, gradient: Tensor, learning_rate: float) -> Tensor:
        """Make one step, or skip it if the gradient [n, 3] is not finite or exceeds `LARGEST_GRADIENT`.

        Returns:
            Largest magnitude in the gradient, in units of a 0-255 input: a scalar on the colors' device. The caller
                checks whether it was too large when it next synchronizes with the device.
        """
        if self._unit != 1:
            gradient = gradient / self._unit**2
        if self._chroma_of is not None:
            # The derivative with respect to a value added to all three channels. Adam's steps are then the same in each
            # channel.
            gradient = gradient.sum(dim=1, keepdim=True).expand(-1, 3).contiguous()
        if self._subspace is not None:
            # Adam scales each channel separately. Without the projection, its steps could ascend within the subspace.
            gradient = self._subspace.along(gradient)
        largest = gradient.abs().amax()
        self._colors.grad = gradient.to(self._colors.dtype)
        if self._fused:
            # PyTorch's flag for an unusable gradient in a fused step, intended for scaled half precision.
            self._step(learning_rate, torch.logical_not(largest <= LARGEST_GRADIENT).float())
        elif not is_too_large(float(largest)):
            self._step(learning_rate)
        else:
            return largest
        if self._bounded or self._chroma_of is not None or self._subspace is not None:
            with torch.no_grad():
                projected = constrained(self._colors, self._chroma_of, self._subspace, bounded=self._bounded)
                unchanged = ~(largest <= LARGEST_GRADIENT)  # the step was skipped
                if self._frozen is not None:
                    unchanged = unchanged | self._frozen
                self._colors.copy_(torch.where(unchanged, self._colors, projected))
        return largest

    @torch.no_grad()
    def _step(self, learning_rate: float, found_inf: Tensor | None = None) -> None:
        """Make a step, unless `found_inf` is non-zero."""
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

    def moments(self) -> tuple[Tensor, Tensor]:
        """Return the first and second moment [n, 3] on the CPU; zeros before the first step."""
        return self._first.cpu().clone(), self._second.cpu().clone()

    def load_moments(self, step: int, first: Tensor, second: Tensor) -> None:
        """Restore the moments [n, 3] after a number of steps, at least one."""
        self._steps.fill_(step)
        self._first.copy_(first)
        self._second.copy_(second)


def constrained(
    colors: Tensor, chroma_of: Tensor | None, subspace: ColorSubspace | None = None, *, bounded: bool
) -> Tensor:
    """Project DC coefficients [n, 3] to their constraints, without accumulating rounding errors in their chroma.

    Args:
        colors: [n, 3].
        chroma_of: [n, 3], colors whose chroma is preserved; None if chroma may change.
        subspace: Color subspace that colors are projected to; they leave it where it leaves the range. None for any
            color.
        bounded: Whether colors must be in 0..1.
    """
    colors = colors if subspace is None else subspace.projected(colors)
    if chroma_of is None:
        return on_screen(colors) if bounded else colors
    return with_chroma_of(on_screen_by_luminance(colors) if bounded else colors, chroma_of)


def is_too_large(largest: float) -> bool:
    """Return whether a gradient with this largest magnitude (possibly NaN) is unusable."""
    return not largest <= LARGEST_GRADIENT
