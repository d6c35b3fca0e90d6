"""Less overhead in Triton's interpreter, which runs the kernels of most tests."""

import inspect
from functools import cache
from typing import Any

import torch


def prepare() -> None:
    """Make the interpreter faster, with the same results, and multiply in bfloat16 as GPUs do."""
    _replace_builtins_once()
    _remember_types()
    _compute_in_bfloat16()
    _use_large_blocks()


def _replace_builtins_once() -> None:
    """Search Triton's language for its built-in functions once, and replace them once per launch.

    The interpreter does both at every call of a device function.
    """
    from triton.runtime import interpreter

    language: Any = interpreter.tl
    is_builtin: Any = language.core.is_builtin

    @cache
    def builtin_names(package: Any) -> list[str]:
        return [name for name, member in inspect.getmembers(package) if is_builtin(member)]

    def patch_builtin(package: Any, *scope: Any) -> None:
        for name in builtin_names(package):
            member = getattr(package, name)
            if is_builtin(member):
                interpreter._patch_attr(package, name, member, *scope)

    @cache
    def visible(function: Any) -> list[Any]:
        return [
            each for each in (language, language.core) if any(value is each for value in function.__globals__.values())
        ]

    patch_language: Any = interpreter._patch_lang

    def call(self: Any, *args: Any, **options: Any) -> Any:
        if is_builtin(language.tensor.__add__) or any(is_builtin(each.load) for each in visible(self.fn)):
            patch_language(self.fn)
        try:
            return self.rewrite()(*args, **options)
        except Exception as error:
            raise interpreter.InterpreterError(repr(error)) from error

    interpreter._patch_builtin = patch_builtin
    interpreter.InterpretedFunction.__call__ = call


def _remember_types() -> None:
    """Make the type of each shape, and its shape as Triton's constants, once instead of for each intermediate value."""
    from triton.language.semantic import TritonSemantic
    from triton.runtime import interpreter

    core: Any = interpreter.tl.core
    first_block, first_tensor = core.block_type.__init__, core.tensor.__init__
    broadcast: Any = TritonSemantic.broadcast_impl_value
    unwrap, numpy_type = core._unwrap_if_constexpr, interpreter._get_np_dtype
    blocks, shapes, numpy_types = dict[Any, dict[str, Any]](), dict[Any, tuple[Any, Any]](), dict[str, Any]()

    def block(self: Any, element_ty: Any, shape: Any) -> None:
        key = (element_ty.name, *(each.value if type(each) is core.constexpr else each for each in shape))
        if key not in blocks:
            first_block(self, element_ty, shape)
            blocks[key] = self.__dict__
        self.__dict__ = blocks[key]

    def tensor(self: Any, handle: Any, kind: Any) -> None:
        key = tuple(kind.shape.values) if kind.is_block() else ()
        if key not in shapes:
            first_tensor(self, handle, kind)
            shapes[key] = self.shape, self.numel
        self.handle, self.type, self.dtype = handle, kind, kind.scalar
        self.shape, self.numel = shapes[key]

    def broadcast_unequal(self: Any, left: Any, right: Any) -> Any:
        return (left, right) if left.shape is right.shape else broadcast(self, left, right)

    def unwrap_constant(value: Any) -> Any:
        if type(value) is core.constexpr:
            return value.value
        return value if type(value) in (core.tensor, int, float, bool) else unwrap(value)

    def known_numpy_type(kind: Any) -> Any:
        name = kind.scalar.name
        if name not in numpy_types:
            numpy_types[name] = numpy_type(kind)
        return numpy_types[name]

    core.block_type.__init__ = block
    core.tensor.__init__ = tensor
    core._unwrap_if_constexpr = unwrap_constant
    TritonSemantic.broadcast_impl_value = broadcast_unequal
    interpreter._get_np_dtype = known_numpy_type


def _compute_in_bfloat16() -> None:
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


def _use_large_blocks() -> None:
    """Let programs process more at a time: the time of an operation hardly depends on its size in the interpreter."""
    from sgsst_core.features import statistics
    from sgsst_core.loss import terms

    statistics.POSITIONS = {2: 4096, 4: 4096}
    statistics.ENTRIES, terms.POSITIONS = 1 << 18, 4096
