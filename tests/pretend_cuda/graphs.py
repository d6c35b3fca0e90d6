"""CUDA graphs of the simulated device."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.utils._pytree import tree_leaves

from tests.pretend_cuda import device


@contextmanager
def plainly() -> Iterator[None]:
    """Disable the simulated device's modes within the block, for internal computations of Triton's interpreter."""
    with torch._C.DisableTorchFunction(), torch.utils._python_dispatch._disable_current_modes():
        yield


class CUDAGraph:
    """Simulated CUDA graph: recorded operations, which a replay repeats on the same tensors.

    On a GPU, operations do not run during capture. Here they do, so their results are set to NaN at the end of the
    capture. They are valid only after a replay.
    """

    def __init__(self, keep_graph: bool = False) -> None:
        self._steps: list[tuple[Any, Any, Any, list[torch.Tensor | None]]] = []
        self._written: list[torch.Tensor] = []
        self._done = False

    def record(self, func: Any, args: Any, kwargs: Any, result: Any) -> None:
        """Store an operation. Views and allocations are skipped, because a replay uses the same memory."""
        schema = getattr(func, "_schema", None)
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        places = {tensor.untyped_storage().data_ptr() for tensor in given}
        outputs = [leaf for leaf in tree_leaves(result) if isinstance(leaf, torch.Tensor)]
        into = [None if tensor.untyped_storage().data_ptr() in places else tensor for tensor in outputs]
        fresh = [tensor for tensor in into if tensor is not None]
        self._written += fresh
        if schema is not None:
            if schema.is_mutable:
                self._written += given[:1]
            elif not fresh or "empty" in schema.name:
                return
        self._steps.append((func, args, kwargs, into))

    def end(self) -> None:
        """Finish the capture, and set the results of its operations to NaN."""
        self._done = True
        with plainly():
            for tensor in self._written:
                if tensor.is_floating_point():
                    tensor.fill_(torch.nan)
        self._written.clear()

    def replay(self) -> None:
        """Repeat all operations. This counts as one launch."""
        if not self._done:
            raise RuntimeError("Called CUDAGraph::replay without a preceding successful capture.")
        device.refuse_in_capture("another graph")
        device.launch()
        with plainly(), torch.no_grad():
            for func, args, kwargs, into in self._steps:
                outputs = [leaf for leaf in tree_leaves(func(*args, **kwargs)) if isinstance(leaf, torch.Tensor)]
                for place, value in zip(into, outputs, strict=False):
                    if place is not None:
                        place.copy_(value)


@contextmanager
def graph(
    cuda_graph: CUDAGraph, pool: Any = None, stream: Any = None, capture_error_mode: str = "global"
) -> Iterator[None]:
    """Capture the operations of this thread within the block, as `torch.cuda.graph` does.

    If it fails, PyTorch before 2.13 leaves the allocator in capture mode.
    """
    device.refuse_in_capture("another capture")
    device.wait()
    device.capture.recorders.append(cuda_graph.record)
    try:
        yield
    except BaseException:
        device.capture.stuck = torch.__version__ < "2.13"
        raise
    finally:
        device.capture.recorders.clear()
    cuda_graph.end()
