"""Less overhead in Triton's interpreter, which runs the kernels of most tests."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any


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
