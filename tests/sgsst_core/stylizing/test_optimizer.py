"""Tests that the project's Adam is bit-identical to PyTorch's, and that it imports no unneeded modules."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from sgsst_core.stylizing.stylizer import ADAM_EPS, ColorOptimizer

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.gpu] if DEVICE == "cuda" else []
STEPS = 6


def gradients() -> list[Tensor]:
    """Return gradients of very different magnitudes, including zeros as for Gaussians outside of a view."""
    generator = torch.Generator().manual_seed(1)
    sizes = 10.0 ** torch.linspace(-18, 18, 90)[:, None]
    drawn = [torch.randn((90, 3), generator=generator) * sizes for _ in range(STEPS)]
    return [(gradient * (torch.rand((90, 1), generator=generator) > 0.3)).to(DEVICE) for gradient in drawn]


def rate(step: int) -> float:
    return float(0.3 * 0.7**step)


def test_steps_are_bit_identical_to_pytorchs_adam() -> None:
    start = torch.randn((90, 3), generator=torch.Generator().manual_seed(2)).to(DEVICE)
    colors, theirs = start.clone(), start.clone().requires_grad_()
    optimizer = ColorOptimizer(colors)
    adam = torch.optim.Adam([theirs], lr=1.0, eps=ADAM_EPS, fused=DEVICE == "cuda")
    for step, gradient in enumerate(gradients()):
        adam.param_groups[0]["lr"] = rate(step)
        theirs.grad = gradient
        adam.step()
        optimizer.update(gradient, rate(step))
        assert torch.equal(colors.detach(), theirs.detach()), step
    first, second = optimizer.moments()
    assert torch.equal(first, adam.state[theirs]["exp_avg"].cpu())
    assert torch.equal(second, adam.state[theirs]["exp_avg_sq"].cpu())


def test_steps_from_loaded_moments_are_bit_identical() -> None:
    start = torch.randn((90, 3), generator=torch.Generator().manual_seed(2)).to(DEVICE)
    whole = ColorOptimizer(colors := start.clone())
    for step, gradient in enumerate(gradients()):
        if step == STEPS // 2:
            again = ColorOptimizer(half := colors.detach().clone())
            again.load_moments(step, *whole.moments())
        whole.update(gradient, rate(step))
        if step >= STEPS // 2:
            again.update(gradient, rate(step))
    assert torch.equal(half.detach(), colors.detach())


@pytest.mark.slow
def test_step_does_not_import_pytorchs_compiler() -> None:
    """The compiler would take two seconds and 140 MB in every process that optimizes."""
    code = (
        "import sys, torch\n"
        "from sgsst_core.stylizing.stylizer import ColorOptimizer\n"
        "ColorOptimizer(torch.zeros(4, 3)).update(torch.ones(4, 3), 0.1)\n"
        "sys.exit('torch._dynamo' in sys.modules)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
