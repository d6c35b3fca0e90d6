"""Less overhead in Triton's interpreter, which runs the kernels of most tests."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any

import torch


def cache_names_of_builtins() -> None:
    """Search Triton's language for its built-in functions once, not at every call of a device function.

    The interpreter searches for them in order to replace them. That takes a third of the time of a kernel, and the
    names are always the same.
    """
    from triton.runtime import interpreter

    is_builtin: Any = interpreter.tl.core.is_builtin

    @cache
    def builtin_names(package: Any) -> list[str]:
        return [name for name, member in inspect.getmembers(package) if is_builtin(member)]

    def patch_builtin(package: Any, *scope: Any) -> None:
        for name in builtin_names(package):
            member = getattr(package, name)
            if is_builtin(member):
                interpreter._patch_attr(package, name, member, *scope)

    interpreter._patch_builtin = patch_builtin


def compute_in_bfloat16() -> None:
    """Multiply matrices in bfloat16, and round to it to nearest, as GPUs do.

    The interpreter multiplies the bits of matrix entries as integers, and truncates.
    """
    from triton.runtime import interpreter

    builder, float32 = interpreter.InterpreterBuilder, interpreter.tl.float32
    multiply: Any = builder.create_dot
    cast: Any = builder.cast_impl

    def create_dot(self: Any, left: Any, right: Any, *options: Any) -> Any:
        both = (self.create_fp_ext(x, float32) if x.dtype.scalar.is_bf16() else x for x in (left, right))
        return multiply(self, *both, *options)

    def cast_impl(self: Any, source: Any, kind: Any) -> Any:
        if source.dtype.scalar.is_fp32() and kind.scalar.is_bf16():
            bits = torch.from_numpy(source.data).bfloat16().view(torch.uint16).numpy()
            return interpreter.TensorHandle(bits, kind.scalar)
        return cast(self, source, kind)

    builder.create_dot = create_dot
    builder.cast_impl = cast_impl
