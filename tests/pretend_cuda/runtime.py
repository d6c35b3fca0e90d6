"""Replacements of `torch.cuda` (events, streams, memory) and of Triton's launches for the simulated device."""

from __future__ import annotations

import threading
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
from tests.pretend_cuda.graphs import CUDAGraph, graph, plainly

#: Bytes of the simulated device's memory.
MEMORY = 140 << 30


class Stream:
    """Stream of the simulated device. All streams are equivalent, because operations run immediately."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.device = device.DEVICE


class Event:
    """Event that records a time of the host's clock."""

    def __init__(self, enable_timing: bool = False, blocking: bool = False, **_: Any) -> None:
        self._timed = enable_timing
        self._moment: float | None = None

    def record(self, stream: Stream | None = None) -> None:
        """Record the current time."""
        if self._timed:
            device.refuse_in_capture("an event with timing")
        self._moment = time.perf_counter()

    def query(self) -> bool:
        """Return whether the event has been recorded."""
        return self._moment is not None

    def synchronize(self) -> None:
        """Count a host synchronization."""
        device.wait()

    def elapsed_time(self, end: Event) -> float:
        """Return the milliseconds from this event to `end`. Both must have been recorded with timing enabled."""
        if not (self._timed and end._timed):
            raise ValueError("Both events must be created with argument 'enable_timing=True'.")
        if self._moment is None or end._moment is None:
            raise RuntimeError("Both events must be recorded before calculating elapsed time.")
        return 1e3 * (end._moment - self._moment)


class _Current(threading.local):
    """Index of each thread's current device; all tensors of the simulated device are on device 0."""

    index = 0


current = _Current()


class _Selected:
    """Replacement of `torch.cuda.device`."""

    def __init__(self, to: Any) -> None:
        self._to, self._before = torch.cuda._utils._get_device_index(to, optional=True), 0

    def __enter__(self) -> None:
        self._before, current.index = current.index, self._to

    def __exit__(self, *_: object) -> None:
        current.index = self._before


def _set_device(to: Any) -> None:
    """Replacement of `torch.cuda.set_device`. Like CUDA's, it requires an index, or a device with an index."""
    current.index = torch.cuda._utils._get_device_index(to)


def _count_launch(original: Any) -> Any:
    def call(executor: Any, *args: Any, **kwargs: Any) -> Any:
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        if any(isinstance(tensor, device.PretendTensor) for tensor in tensors):
            if not all(isinstance(tensor, device.PretendTensor) for tensor in tensors):
                raise ValueError("Pointer argument cannot be accessed from Triton (cpu tensor?)")
            if current.index != 0:
                raise RuntimeError("Triton Error [CUDA]: an illegal memory access was encountered")
            device.launch()
        values, named = [device.inner(arg) for arg in args], {name: device.inner(arg) for name, arg in kwargs.items()}
        # While a graph is captured, the values of its inputs are meaningless.
        with plainly(), np.errstate(all="ignore" if device.capture.recorders else None):
            result = original(executor, *values, **named)
        for record in device.capture.recorders:
            record(lambda *a, **k: original(executor, *a, **k), values, named, None)
        return result

    return call


@contextmanager
def pretend_cuda() -> Iterator[Counts]:
    """Simulate a CUDA device within the block, and yield its counters, which start at zero."""
    from triton.runtime.interpreter import GridExecutor

    properties = mock.Mock(total_memory=MEMORY, multi_processor_count=132, L2_cache_size=50 << 20, name="pretend")
    one = Stream()
    instead: dict[str, Any] = {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: current.index,
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
        "device": _Selected,
        "is_current_stream_capturing": lambda: bool(device.capture.recorders),
        "Stream": Stream,
        "Event": Event,
        "CUDAGraph": CUDAGraph,
        "graph": graph,
        "graph_pool_handle": lambda: (0, 1),
    }
    device.counts.clear()
    device.capture.stuck = False
    current.index = 0
    with (
        mock.patch.multiple(torch.cuda, **instead),
        # A convolution that fills a GPU takes a processor seconds, and the times of this device mean nothing.
        mock.patch.dict("sgsst_core.stylizing.job._SIDES", cuda=(16, 16)),
        mock.patch.object(torch.distributed, "is_nccl_available", return_value=False),
        mock.patch.object(GridExecutor, "__call__", _count_launch(GridExecutor.__call__)),
        device.modes(),
    ):
        yield device.counts
