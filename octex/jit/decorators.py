"""What compiles functions: kernels, which Python calls, and parts, which only kernels call."""

from __future__ import annotations

import functools
from collections.abc import Callable
from operator import is_
from typing import Any, TypeVar

import numba
import numpy as np
from numba.extending import models, register_model, typeof_impl

from octex.arrays import Array

Function = TypeVar("Function", bound=Callable[..., Any])

#: True when kernels run as plain Python.
DISABLED: bool = bool(numba.config.DISABLE_JIT)


class Part:
    """A compiled function that kernels call."""

    #: Whether numba compiles it anew for each constant that it is called with.
    by_constants = False

    def __init__(self, compiled: Any) -> None:
        self.compiled, self.py_func = compiled, compiled.py_func
        functools.update_wrapper(self, compiled.py_func)

    def __call__(self, *_arguments: Any) -> Any:
        """Raise TypeError: numba made nothing that Python can call."""
        raise TypeError(f"{self.py_func.__qualname__} can be called in kernels only")

    def __reduce__(self) -> str:
        return str(self.py_func.__qualname__)  # other processes have their own


class Kernel(Part):
    """A compiled function that Python calls, too; all arrays pass as writable, for one version."""

    def __call__(self, *arguments: Any) -> Any:
        """Call the compiled function. It must not write to what Python may not write to."""
        return self.compiled(*map(unlocked, arguments))


class _Callee(numba.types.Dispatcher):  # type: ignore[misc]
    """A compiled function that a kernel calls: once for all constants that it is called with."""

    def get_call_type(self, context: Any, args: Any, kws: Any) -> Any:
        """Tell numba which version is called."""
        kws = {name: numba.types.unliteral(kind) for name, kind in dict(kws).items()}
        return super().get_call_type(context, tuple(map(numba.types.unliteral, args)), kws)


register_model(_Callee)(models.OpaqueModel)


@typeof_impl.register(Part)  # type: ignore[untyped-decorator]
def _type_of(part: Part, _purpose: Any) -> Any:
    """Tell numba that a kernel calls the compiled function."""
    return (numba.types.Dispatcher if part.by_constants else _Callee)(part.compiled)


class _Memory:
    """The memory of an array, to numpy's array protocol, as if it could be written to."""

    def __init__(self, array: Array) -> None:
        interface = array.__array_interface__
        self.__array_interface__ = {**interface, "data": (interface["data"][0], False)}
        self.array = array  # which lives as long as what is made of this


def unlocked(argument: Any) -> Any:
    """Return an argument whose arrays, in tuples too, numba types as writable; kernels only read them."""
    if isinstance(argument, np.ndarray):
        return argument if DISABLED or argument.flags.writeable else np.asarray(_Memory(argument))
    if not isinstance(argument, tuple):
        return argument
    found = tuple(map(unlocked, argument))
    if all(map(is_, found, argument)):
        return argument
    return argument._make(found) if hasattr(argument, "_make") else found


def direct(kernel: Function) -> Function:
    """Return what calls a kernel with arguments that are `unlocked` already: 3 to 8 µs faster."""
    return getattr(kernel, "compiled", kernel)


def kernel(function: Function) -> Function:
    """Compile ``function`` on its first call, cached on disk, releasing the GIL.

    Kernels take arrays, scalars and named tuples of them; they never raise and never allocate per element.
    """
    return _compiled(function, Kernel)


def summing_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let sums be reordered to run in vectors: their last bits may vary."""
    return _compiled(function, Kernel, fastmath={"reassoc", "contract"})


def fused_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, Kernel, fastmath={"contract"})


def part(function: Function) -> Function:
    """Compile ``function`` for kernels alone, a seventh faster; it may create arrays."""
    return _compiled(function)


def fused_part(function: Function) -> Function:
    """Compile like ``part``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, fastmath={"contract"})


def step(function: Function) -> Function:
    """Compile like ``part`` a function that creates no arrays; a call takes 100 to 200 ns less."""
    return _compiled(function, _nrt=False)


def inlined(function: Function) -> Function:
    """Compile like ``step``, into each kernel that calls it: for the small steps of a hot loop."""
    return _compiled(function, _nrt=False, forceinline=True)


def by_constants(function: Function) -> Function:
    """Have what is compiled be so anew for each constant that kernels call it with: some loops gain 3 %."""
    if isinstance(function, Part):
        function.by_constants = True
    return function


def fused_inlined(function: Function) -> Function:
    """Compile like ``inlined``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, _nrt=False, forceinline=True, fastmath={"contract"})


def _compiled(function: Function, kind: type[Part] = Part, **options: Any) -> Function:
    if DISABLED:
        return function
    from octex.jit.cache import cached  # not above: no code is compiled from it

    # Nobody calls kernels from C: without that entry, each compiles faster.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **options}
    return kind(cached(function, {**options, "no_cpython_wrapper": kind is Part}))  # type: ignore[return-value]
