"""`torch.cuda` and Triton's launches for the pretend device: events, streams, memory, graphs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch.utils._pytree import tree_leaves

from tests.pretend_cuda import device
from tests.pretend_cuda.counts import Counts

#: Bytes of the pretend device's memory.
MEMORY = 140 << 30


class Stream:
    """All streams are one: what is asked for is done at once."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.device = device.DEVICE

    def wait_event(self, event: Event) -> None:
        """Nothing is left to wait for."""

    def wait_stream(self, stream: Stream) -> None:
        """Likewise."""

    def record_event(self, event: Event | None = None) -> Event:
        """An event at this moment."""
        event = event or Event()
        event.record(self)
        return event

    def synchronize(self) -> None:
        """The host waits."""
        device.wait()

    def query(self) -> bool:
        """Whether all is done."""
        return True


class Event:
    """A moment on the host's clock."""

    def __init__(self, enable_timing: bool = False, blocking: bool = False, **_: Any) -> None:
        self._timed = enable_timing
        self._moment: float | None = None
        self.read = False

    def record(self, stream: Stream | None = None) -> None:
        """Now."""
        if self._timed:
            device.refuse_in_capture("an event with timing")
        self._moment = time.perf_counter()

    def wait(self, stream: Stream | None = None) -> None:
        """The stream waits, not the host."""

    def query(self) -> bool:
        """Whether it has come."""
        return self._moment is not None

    def synchronize(self) -> None:
        """The host waits."""
        device.wait()

    def elapsed_time(self, end: Event) -> float:
        """Milliseconds; both events must have been recorded, with timing."""
        if not (self._timed and end._timed):
            raise ValueError("Both events must be created with argument 'enable_timing=True'.")
        if self._moment is None or end._moment is None:
            raise RuntimeError("Both events must be recorded before calculating elapsed time.")
        return 1e3 * (end._moment - self._moment)


class CUDAGraph:
    """Operations that were captured, to be done again with the very same tensors.

    Capturing computes nothing on a GPU. Here it does, and what it has computed is made unusable at its end: numbers are
    NaN until a replay has made them.
    """

    def __init__(self, keep_graph: bool = False) -> None:
        self._steps: list[tuple[Any, Any, Any, list[torch.Tensor | None]]] = []
        self._written: list[torch.Tensor] = []
        self._done = False

    def record(self, func: Any, args: Any, kwargs: Any, result: Any) -> None:
        """Hold an operation, but for those that only make a view or reserve memory, which stays where it is."""
        schema = getattr(func, "_schema", None)
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        places = {tensor.untyped_storage().data_ptr() for tensor in given}
        made = [leaf for leaf in tree_leaves(result) if isinstance(leaf, torch.Tensor)]
        into = [None if tensor.untyped_storage().data_ptr() in places else tensor for tensor in made]
        fresh = [tensor for tensor in into if tensor is not None]
        self._written += fresh
        if schema is not None:
            if schema.is_mutable:
                self._written += given[:1]
            elif not fresh or "empty" in schema.name:
                return
        self._steps.append((func, args, kwargs, into))

    def end(self) -> None:
        """Nothing more is captured."""
        self._done = True
        with _plainly():
            for tensor in self._written:
                if tensor.is_floating_point():
                    tensor.fill_(torch.nan)
        self._written.clear()

    def replay(self) -> None:
        """All operations, in one launch."""
        if not self._done:
            raise RuntimeError("Called CUDAGraph::replay without a preceding successful capture.")
        device.refuse_in_capture("another graph")
        device.launch()
        with _plainly(), torch.no_grad():
            for func, args, kwargs, into in self._steps:
                found = [leaf for leaf in tree_leaves(func(*args, **kwargs)) if isinstance(leaf, torch.Tensor)]
                for place, value in zip(into, found, strict=False):
                    if place is not None:
                        place.copy_(value)


@contextmanager
def _graph(
    cuda_graph: CUDAGraph, pool: Any = None, stream: Stream | None = None, capture_error_mode: str = "global"
) -> Iterator[None]:
    """As `torch.cuda.graph`: what this thread asks of the device in the block is captured."""
    device.refuse_in_capture("another capture")
    device.wait()
    device.capture.recorders.append(cuda_graph.record)
    try:
        yield
    finally:
        device.capture.recorders.clear()
    cuda_graph.end()


def _set_device(to: Any) -> None:
    """As `torch.cuda.set_device`: it takes a number or a device with one."""
    torch.cuda._utils._get_device_index(to)


def _count_launch(original: Any) -> Any:
    def call(executor: Any, *args: Any, **kwargs: Any) -> Any:
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        if any(isinstance(tensor, device.PretendTensor) for tensor in tensors):
            if not all(isinstance(tensor, device.PretendTensor) for tensor in tensors):
                raise ValueError("Pointer argument cannot be accessed from Triton (cpu tensor?)")
            device.launch()
        values, named = [device.inner(arg) for arg in args], {name: device.inner(arg) for name, arg in kwargs.items()}
        # While a graph is captured, what its inputs hold means nothing.
        with _plainly(), np.errstate(all="ignore" if device.capture.recorders else None):
            result = original(executor, *values, **named)
        for record in device.capture.recorders:
            record(lambda *a, **k: original(executor, *a, **k), values, named, None)
        return result

    return call


@contextmanager
def _plainly() -> Iterator[None]:
    """Without the device's modes: what the interpreter computes with is its own."""
    with torch._C.DisableTorchFunction(), torch.utils._python_dispatch._disable_current_modes():
        yield


@contextmanager
def pretend_cuda() -> Iterator[Counts]:
    """Within the block there is a CUDA device; what it is asked for is counted from nothing."""
    from triton.runtime.interpreter import GridExecutor

    properties = mock.Mock(total_memory=MEMORY, multi_processor_count=132, L2_cache_size=50 << 20, name="pretend")
    one = Stream()
    instead: dict[str, Any] = {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "set_device": _set_device,
        "synchronize": lambda *_: device.wait(),
        "get_device_name": lambda *_: "pretend",
        "get_device_properties": lambda *_: properties,
        "get_device_capability": lambda *_: (9, 0),
        "is_bf16_supported": lambda *_, **__: True,
        "mem_get_info": lambda *_: (int(0.98 * MEMORY), MEMORY),
        "memory_allocated": lambda *_: 0,
        "max_memory_allocated": lambda *_: 0,
        "reset_peak_memory_stats": lambda *_: None,
        "empty_cache": lambda: None,
        "current_stream": lambda *_: one,
        "default_stream": lambda *_: one,
        "stream": lambda *_: nullcontext(),
        "device": lambda *_: nullcontext(),
        "is_current_stream_capturing": lambda: bool(device.capture.recorders),
        "Stream": Stream,
        "Event": Event,
        "CUDAGraph": CUDAGraph,
        "graph": _graph,
        "graph_pool_handle": lambda: (0, 1),
    }
    device.counts.clear()
    with (
        mock.patch.multiple(torch.cuda, **instead),
        mock.patch.object(GridExecutor, "__call__", _count_launch(GridExecutor.__call__)),
        device.modes(),
    ):
        yield device.counts
