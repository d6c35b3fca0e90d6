"""Tensors that report "cuda:0" as their device, but compute on the CPU and count the work that a GPU would do.

Every PyTorch operation on such a tensor passes through `dispatch`. As CUDA does, it refuses to mix devices. It also
counts kernels, host synchronizations and copies. An operation counts as one kernel, unless `_KERNELS` lists another
number, or as none if it only creates a view or allocates memory. On a GPU, libraries may launch a few more.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from tests.pretend_cuda.counts import Counts, calling_line

DEVICE = torch.device("cuda", 0)
#: Global counters of this process.
counts = Counts()


class _Capture(threading.local):
    """Thread-local state of a graph capture.

    Attributes:
        recorders: Callbacks that receive each captured operation, its arguments, its keyword arguments and its result,
            all with CPU tensors.
        stuck: Whether a capture has failed in a version of PyTorch whose allocator then stays in capture mode.
    """

    def __init__(self) -> None:
        self.recorders: list[Callable[[Any, Any, Any, Any], None]] = []
        self.stuck = False


capture = _Capture()

#: Operations without a kernel: they create a view, allocate memory or query a property.
_NO_KERNEL = {
    "view", "_unsafe_view", "_reshape_alias", "permute", "transpose", "t", "slice", "select", "unsqueeze", "squeeze",
    "expand", "alias", "detach", "split", "split_with_sizes", "unbind", "as_strided", "diagonal", "lift_fresh",
    "unfold",
    "empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided", "_local_scalar_dense", "is_same_size",
    "record_stream", "is_pinned", "view_as_real", "sym_size", "sym_stride", "narrow",
}  # fmt: skip
#: Numbers of kernels of operations that may launch several: sorts take several passes. The bias of a convolution is
#: counted separately.
_KERNELS = {"sort": 6, "topk": 4, "nonzero": 3, "cumsum": 2, "cat": 1}
#: Operations after which the host waits for the device, because it needs the size or the value of their result.
_WAITS = {
    "_local_scalar_dense", "nonzero", "masked_select", "equal", "unique_consecutive", "_unique2", "unique_dim",
    "bincount", "repeat_interleave", "is_nonzero", "linalg_lstsq", "histc",
}  # fmt: skip
#: Operations that accept a mix of CPU tensors and simulated tensors.
_MIXED = {"copy_", "_to_copy", "index", "index_put_", "index_put", "_index_put_impl_", "_pin_memory"}


class PretendTensor(Tensor):
    """Tensor on the simulated device; `host` holds its values on the CPU."""

    host: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, values: Tensor) -> PretendTensor:
        wrapped = Tensor._make_wrapper_subclass(
            cls,
            values.size(),
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=DEVICE,
        )
        wrapped.host = values
        return wrapped

    def __repr__(self, *_: Any, **__: Any) -> str:  # type: ignore[override]
        return f"PretendTensor({self.host})"

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first.")

    __array__ = numpy

    def record_stream(self, stream: Any) -> None:
        """Do nothing, because operations run immediately, so no memory is freed too early."""

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        return dispatch(func, args, kwargs or {})


def inner(value: Any) -> Any:
    """Return the CPU tensor that holds the values of a simulated tensor; return any other value unchanged."""
    return value.host if isinstance(value, PretendTensor) else value


def wait(line: str | None = None) -> None:
    """Count a host synchronization: a wait of the host for the device."""
    if capture.stuck:
        raise RuntimeError("captures_underway.empty() INTERNAL ASSERT FAILED")
    refuse_in_capture("the host waits for the device")
    counts.waits[line or calling_line()] += 1


def refuse_in_capture(what: str) -> None:
    """Raise an error if a graph is being captured, as CUDA does for operations that graphs do not support.

    Raises:
        RuntimeError: If a graph is being captured.
    """
    if capture.recorders:
        raise RuntimeError(f"operation not permitted when stream is capturing: {what}")


def launch(kernels: int = 1) -> None:
    """Count kernel launches, unless a graph is being captured."""
    if not capture.recorders:
        counts.launches[calling_line()] += kernels


def dispatch(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run a PyTorch operation on the CPU, and count the work that CUDA would do."""
    name = func._schema.name.removeprefix("aten::")
    leaves = tree_leaves((args, kwargs))
    on_device = [leaf for leaf in leaves if isinstance(leaf, PretendTensor)]
    asked = kwargs.get("device")
    if asked is not None:
        to_device = torch.device(asked).type == "cuda"
        kwargs = {**kwargs, "device": torch.device("cpu")}
    else:
        to_device = bool(on_device)
    if on_device:
        _refuse_mixed(func, name, args, leaves)
    if on_device or to_device:
        _count(name, func, args, kwargs, to_device)
    plain, named = tree_map(inner, args), tree_map(inner, kwargs)
    if name == "_to_copy" and named.get("non_blocking"):
        named = {**named, "non_blocking": False}
    result = func(*plain, **named)
    if on_device or to_device:
        for record in capture.recorders:
            record(func, plain, named, result)
    return _wrapped(func, result, leaves) if to_device else result


def _wrapped(func: Any, result: Any, leaves: list[Any]) -> Any:
    """Wrap a result as a simulated tensor. For an in-place operation, return the argument itself."""
    changed = {id(leaf.host): leaf for leaf in leaves if isinstance(leaf, PretendTensor)}

    def wrap(value: Any) -> Any:
        if not isinstance(value, Tensor) or isinstance(value, PretendTensor):
            return value
        if func._schema.is_mutable and id(value) in changed:
            before = changed[id(value)]
            if before.shape != value.shape or before.stride() != value.stride():
                raise NotImplementedError(f"the pretend device does not change a tensor's shape in place: {func}")
            return before
        return PretendTensor(value)

    return tree_map(wrap, result)


def _refuse_mixed(func: Any, name: str, args: Any, leaves: list[Any]) -> None:
    host = [leaf for leaf in leaves if isinstance(leaf, Tensor) and not isinstance(leaf, PretendTensor)]
    if name.startswith("index") and not isinstance(args[0], PretendTensor):
        raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
    if name in _MIXED or func._schema.name.startswith("c10d::"):
        return
    if any(tensor.dim() for tensor in host):
        shape = tuple(next(tensor for tensor in host if tensor.dim()).shape)
        raise RuntimeError(
            f"Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu! ({func}, "
            f"the CPU's has shape {shape})"
        )


def _count(name: str, func: Any, args: Any, kwargs: dict[str, Any], to_device: bool) -> None:
    if name in _WAITS:
        wait()
    if name in ("index", "index_put_", "index_put", "_index_put_impl_"):
        for index in args[1]:
            if isinstance(index, PretendTensor) and index.dtype == torch.bool:
                wait()  # for the number of True values
            elif isinstance(index, Tensor) and not isinstance(index, PretendTensor):
                _count_copy(index, waits=True)
    if name == "_to_copy" and isinstance(args[0], PretendTensor) != to_device:
        staged = to_device and not _is_staged(args[0])  # to the host, PyTorch copies into pinned memory
        _count_copy(args[0], waits=not kwargs.get("non_blocking") or staged)
    elif name == "copy_" and isinstance(args[0], PretendTensor) != isinstance(args[1], PretendTensor):
        asynchronous = (args[2:3] or (kwargs.get("non_blocking"),))[0]
        host = args[1] if isinstance(args[0], PretendTensor) else args[0]
        _count_copy(args[1], waits=not (asynchronous and _is_staged(host)))
    elif name not in _NO_KERNEL and not func._schema.name.startswith("c10d::"):
        kernels = _KERNELS.get(name, 1)
        launch(kernels + (name == "convolution" and args[2] is not None))


def _count_copy(source: Tensor, *, waits: bool) -> None:
    """Count a copy between host and device, and a host synchronization if `waits`.

    CPU scalars need no synchronization, because they are passed with the launch.
    """
    refuse_in_capture("a copy between host and device")
    counts.copies[calling_line()] += source.numel() * source.element_size()
    if waits and not (source.dim() == 0 and not isinstance(source, PretendTensor)):
        wait()


def _is_staged(host: Tensor) -> bool:
    """Return whether a copy is asynchronous: from pinned memory, or so small that the driver stages it."""
    return _is_pinned(host) or (not isinstance(host, PretendTensor) and host.numel() * host.element_size() <= 1 << 16)


def _is_pinned(tensor: Tensor) -> bool:
    return getattr(tensor, "pretend_pinned", False)


class _Factories(TorchDispatchMode):
    """Mode that sends operations that create tensors on the simulated device to `dispatch`."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(func, args, kwargs or {})


class _Moves(TorchFunctionMode):
    """Mode that intercepts calls that fail before they reach `dispatch` if PyTorch was built without CUDA."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is Tensor.to:
            return _to(*args, **kwargs)
        if func is Tensor.cuda:
            return _to(args[0], DEVICE)
        if func is Tensor.cpu:
            return _to(args[0], "cpu")
        if func in (torch.tensor, torch.as_tensor) and _is_cuda(kwargs.get("device")):
            return _to(func(*args, **{**kwargs, "device": "cpu"}), DEVICE)
        if func is Tensor.new_tensor and isinstance(args[0], PretendTensor):
            return _to(args[0].host.new_tensor(*args[1:], **{**kwargs, "device": "cpu"}), kwargs.get("device", DEVICE))
        if func is torch.as_tensor and args and isinstance(args[0], PretendTensor) and kwargs.get("device") is None:
            return args[0].to(kwargs.get("dtype", args[0].dtype))
        if func is Tensor.pin_memory:
            pinned = args[0].clone()
            pinned.pretend_pinned = True
            return pinned
        if func is Tensor.is_pinned:
            return _is_pinned(args[0])
        return func(*args, **kwargs)


def _is_cuda(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def _to(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """Replacement of `Tensor.to` that supports the simulated device."""
    copy = kwargs.pop("copy", False)
    device, dtype, non_blocking, memory_format = torch._C._nn._parse_to(*args, **kwargs)
    device = tensor.device if device is None else device
    dtype = dtype or tensor.dtype
    if device.type == tensor.device.type and dtype == tensor.dtype and not copy and memory_format is None:
        return tensor
    options: dict[str, Any] = {"dtype": dtype, "device": device, "non_blocking": non_blocking}
    if memory_format is not None:
        options["memory_format"] = memory_format
    return dispatch(torch.ops.aten._to_copy.default, (tensor,), options)


@contextmanager
def modes() -> Iterator[None]:
    """Support tensors on the simulated device within the block, and in threads that are started there."""
    _let_tensors_be_on_cuda()
    run = threading.Thread.run

    def in_modes(thread: threading.Thread) -> None:
        with _Factories(), _Moves():
            run(thread)

    threading.Thread.run = in_modes  # type: ignore[method-assign, assignment]
    try:
        with _Factories(), _Moves():
            yield
    finally:
        threading.Thread.run = run  # type: ignore[method-assign]


def _let_tensors_be_on_cuda() -> None:
    """Register the CPU's device guard, which does nothing, for CUDA.

    Indexing and a few other operations need a guard before they reach `dispatch`. PyTorch without CUDA has none, and
    that of PyTorch with CUDA asks the driver, which is missing here. Pointers to guards are stored in a table by device
    type (c10/core/impl/DeviceGuardImplInterface.h); the second entry is CUDA's.
    """
    library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libc10.so"))
    guards = (ctypes.c_void_p * 2).in_dll(library, "_ZN3c104impl26device_guard_impl_registryE")
    guards[1] = guards[0]
