"""Current device of a thread, on which Triton launches kernels."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch


def on_device(device: torch.device) -> AbstractContextManager[None]:
    """Make a GPU the current device inside a `with` block; do nothing for a CPU.

    Triton launches kernels on the current device, wherever their arguments are. Every thread starts with device 0.
    """
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()
