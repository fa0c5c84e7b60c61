"""Decorators that compile functions: kernels for Python, and parts for kernels."""

from __future__ import annotations

import functools
from collections.abc import Callable
from operator import is_
from typing import Any, Protocol, TypeVar

import numba
import numpy as np
from numba.extending import models, register_model, typeof_impl

from octex.arrays import Array

Function = TypeVar("Function", bound=Callable[..., Any])

#: True when kernels run as plain Python.
DISABLED: bool = bool(numba.config.DISABLE_JIT)


class Part:
    """A compiled function that kernels call."""

    by_constants = False

    def __init__(self, compiled: Any) -> None:
        self.compiled, self.py_func = compiled, compiled.py_func
        functools.update_wrapper(self, compiled.py_func)

    def __call__(self, *_arguments: Any) -> Any:
        """Raise TypeError: numba compiled no entry for Python."""
        raise TypeError(f"{self.py_func.__qualname__} can be called in kernels only")

    def __reduce__(self) -> str:
        return str(self.py_func.__qualname__)  # other processes compile it


class Kernel(Part):
    """A compiled function for Python and kernels; all arrays pass as writable, for one version."""

    def __call__(self, *arguments: Any) -> Any:
        """Call the compiled function, which must not write to read-only arrays."""
        return self.compiled(*map(unlocked, arguments))


class _Callee(numba.types.Dispatcher):  # type: ignore[misc]
    """The type of a function that a kernel calls: one version for all constant arguments."""

    def get_call_type(self, context: Any, args: Any, kws: Any) -> Any:
        """Choose the version to call."""
        kws = {name: numba.types.unliteral(kind) for name, kind in dict(kws).items()}
        return super().get_call_type(context, tuple(map(numba.types.unliteral, args)), kws)


register_model(_Callee)(models.OpaqueModel)


@typeof_impl.register(Part)  # type: ignore[untyped-decorator]
def _type_of(part: Part, _purpose: Any) -> Any:
    """Return numba's type of a part."""
    return (numba.types.Dispatcher if part.by_constants else _Callee)(part.compiled)


class _Memory:
    """An array's memory for numpy's array protocol, as writable."""

    def __init__(self, array: Array) -> None:
        interface = array.__array_interface__
        self.__array_interface__ = {**interface, "data": (interface["data"][0], False)}
        self.array = array  # stays alive with the result


def unlocked(argument: Any) -> Any:
    """Return an argument with its arrays, also in tuples, typed as writable; kernels only read them."""
    if isinstance(argument, np.ndarray):
        return argument if DISABLED or argument.flags.writeable else np.asarray(_Memory(argument))
    if not isinstance(argument, tuple):
        return argument
    items = tuple(map(unlocked, argument))
    if all(map(is_, items, argument)):
        return argument
    return argument._make(items) if hasattr(argument, "_make") else items


def direct(kernel: Function) -> Function:
    """Return the function that calls a kernel with `unlocked` arguments: 3 to 8 µs faster."""
    return getattr(kernel, "compiled", kernel)


def by_constants(function: Function) -> Function:
    """Let numba compile a part for each constant argument: lookups take 3 to 15 % less time."""
    if isinstance(function, Part):
        function.by_constants = True
    return function


class Decorator(Protocol):
    """Compiles a function on its first call, cached on disk, releasing the GIL."""

    def __call__(self, function: Function, /) -> Function:
        """Return the compiled function."""


def _decorator(kind: type[Part], **options: Any) -> Decorator:
    # Nobody calls kernels from C: without that entry, each compiles faster.
    entries = {"no_cfunc_wrapper": True, "no_cpython_wrapper": kind is Part}
    options = {"nogil": True, "error_model": "numpy", **entries, **options}

    def compiled(function: Function) -> Function:
        if DISABLED:
            return function
        from octex.jit.cache import cached  # not above: no code is compiled from it

        return kind(cached(function, options))  # type: ignore[return-value]

    return compiled


#: Rounds a product and a sum once, as one instruction.
_FUSED = {"fastmath": {"contract"}}
#: Creates no arrays; a call takes 100 to 200 ns less.
_STEP = {"_nrt": False}
#: Compiled into each calling kernel: for the small steps of a hot loop.
_INLINED = {**_STEP, "forceinline": True}

#: Kernels take arrays, scalars and named tuples of them; they never raise and never allocate per element.
kernel = _decorator(Kernel)
fused_kernel = _decorator(Kernel, **_FUSED)
#: Sums are reordered for vectors: their last bits may vary.
summing_kernel = _decorator(Kernel, fastmath={"reassoc", "contract"})
#: For kernels only: a seventh faster to compile. It may create arrays.
part = _decorator(Part)
fused_part = _decorator(Part, **_FUSED)
step = _decorator(Part, **_STEP)
inlined = _decorator(Part, **_INLINED)
fused_inlined = _decorator(Part, **_FUSED, **_INLINED)
