"""What compiles functions: kernels, which Python calls, and parts, which only kernels call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

#: True when kernels run as plain Python.
DISABLED: bool = bool(numba.config.DISABLE_JIT)


def kernel(function: Function) -> Function:
    """Compile ``function`` on its first call, cached on disk, releasing the GIL.

    Kernels take arrays, scalars and named tuples of them; they never raise and never allocate per element.
    """
    return _compiled(function)


def summing_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let sums be reordered to run in vectors: their last bits may vary."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def fused_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, fastmath={"contract"})


def part(function: Function) -> Function:
    """Compile ``function`` for kernels to call. It may create arrays, as ``kernel`` lets it.

    Without the wrapper that Python would call, each part compiles a seventh faster.
    """
    return _compiled(function, no_cpython_wrapper=True)


def fused_part(function: Function) -> Function:
    """Compile like ``part``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, no_cpython_wrapper=True, fastmath={"contract"})


def step(function: Function) -> Function:
    """Compile like ``part`` a function that creates no arrays.

    Without numba's runtime it counts no references, which otherwise costs 100 to 200 ns a call with a tuple
    of arrays.
    """
    return _compiled(function, no_cpython_wrapper=True, _nrt=False)


def inlined(function: Function) -> Function:
    """Compile like ``step``, into each kernel that calls it.

    For the small steps of a hot loop, where a call costs as much as the work.
    """
    return _compiled(function, no_cpython_wrapper=True, _nrt=False, forceinline=True)


def public_inlined(function: Function) -> Function:
    """Compile like ``inlined`` a function for users' kernels, which Python can call too.

    To call one of the others from Python ends the process.
    """
    return _compiled(function, _nrt=False, forceinline=True)


def _compiled(function: Function, **options: Any) -> Function:
    from octex.jit.cache import cached  # not above: no code is compiled from it

    # Nobody calls kernels from C: without that entry, each compiles faster.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **options}
    if DISABLED:
        return numba.njit(**options)(function)  # type: ignore[no-any-return]
    return cached(function, options)  # type: ignore[no-any-return]
