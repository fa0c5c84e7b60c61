"""What compiles functions: kernels, which Python calls, and the parts that only kernels call."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from operator import attrgetter
from threading import Lock
from typing import Any, TypeVar

import numba
import numpy as np
from numba import types

from octex.jit.compilers import USED, PartCompiler, PartContext, WholeCompiler

Function = TypeVar("Function", bound=Callable[..., Any])

#: What is used of numba beyond what it documents, of its functions and of their caches on disk.
_USED = "_compile_for_args", "_insert", "add_overload", "get_call_template", "overloads", "typeof_pyval"
_USED_OF_CACHE = (
    *("_cache._cache_file.load", "_cache._cache_file.save", "_cache._cache_file._source_stamp"),
    *("_cache._impl.rebuild", "_cache.cache_path", "_cache.save_overload"),
)
#: New objects after which Python looks for garbage while kernels are compiled, which make hundreds of
#: thousands: by its own 700, that takes a tenth of the time.
MANY_OBJECTS = 100_000

#: True when kernels run as plain Python.
DISABLED: bool = bool(numba.config.DISABLE_JIT)


def kernel(function: Function) -> Function:
    """Compile ``function`` on first call, cached on disk, releasing the GIL.

    Kernels take arrays, scalars and named tuples of them; they never raise and never allocate per element.
    """
    return _compiled(function)


def inlined(function: Function) -> Function:
    """Compile ``function`` into the kernels that call it.

    For the small steps of a hot loop, where a call costs as much as the work. They must not create arrays:
    without numba's runtime they count no references, which otherwise costs 100 to 200 ns a call with a tuple
    of arrays (coherent lookups: 24 million a second instead of 4). Only kernels can call them: without what
    Python calls, octex compiles in six sevenths of the time.
    """
    return _part(function, forceinline=True, _nrt=False)


def step(function: Function) -> Function:
    """Compile ``function`` for kernels to call, as ``inlined`` does, but not into each call."""
    return _part(function, _nrt=False)


def part(function: Function) -> Function:
    """Compile ``function`` for kernels to call. It may create arrays, as ``kernel`` lets it."""
    return _part(function)


def fused_part(function: Function) -> Function:
    """Compile like ``part``, but let a product and a sum be one instruction, rounded once."""
    return _part(function, fastmath={"contract"})


def _part(function: Function, **options: Any) -> Function:
    """Compile a function that only kernels can call."""
    compiled: Any = _compiled(function, PartCompiler, no_cpython_wrapper=True, **options)
    if not DISABLED:
        compiled.add_overload = partial(_add_overload, compiled)
        compiled._compile_for_args = partial(_refuse, compiled.__name__)
    return compiled  # type: ignore[no-any-return]


def _add_overload(compiled: Any, result: Any) -> None:
    """Note what was compiled for a kernel's call, out of Python's reach."""
    compiled.overloads[tuple(result.signature.args)] = result


def _refuse(name: str, *_arguments: Any, **_keywords: Any) -> None:
    raise TypeError(f"{name} can be called in kernels only")


def summing_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let sums be reordered to run in vectors: their last bits may vary."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def fused_kernel(function: Function) -> Function:
    """Compile like ``kernel``, but let a product and a sum be one instruction, rounded once."""
    return _compiled(function, fastmath={"contract"})


def _compiled(function: Function, by: type[Any] = WholeCompiler, **options: Any) -> Function:
    from octex.jit.cache import CodeFiles  # not above: nothing is compiled from it

    # Without the entry for C, which nobody calls, each version is a module less to compile.
    plain = partial(numba.njit, nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)
    compiler = partial(plain, pipeline_class=by)
    used: tuple[str, ...] = (*_USED, *_USED_OF_CACHE)
    try:
        compiled: Any = compiler(cache=True)(function)
    except RuntimeError:  # no folder that numba could write its cache to: compile in every process
        compiled, used = compiler(cache=False)(function), _USED
    if DISABLED:
        return compiled  # type: ignore[no-any-return]
    missing = [name for name in used if not _has(compiled, name)]
    missing += [name for owner, names in USED for name in names if not hasattr(owner, name)]
    if missing:
        # Code that is kept on disk by numba's rules alone may be stale.
        warnings.warn(
            f"numba {numba.__version__} has no {' and no '.join(missing)} in its functions, which octex "
            f"uses: {function.__name__} is compiled in every process; install a numba that octex knows",
            RuntimeWarning,
            stacklevel=3,
        )
        return plain(cache=False)(function)  # type: ignore[no-any-return]
    compiled.get_call_template = partial(_call_template, compiled.get_call_template)
    compiled._compile_for_args = partial(_compile_for_args, compiled, compiled._compile_for_args, set())
    if used != _USED:
        kept = compiled._cache
        kept._cache_file = CodeFiles(kept.cache_path, function, kept._cache_file._source_stamp)
        kept.save_overload = partial(_keep, kept.save_overload)
        if by is PartCompiler:
            kept._impl.rebuild = partial(_rebuild_part, kept._impl.rebuild)
        compiled.compile = partial(_compile, compiled.compile, kept._cache_file)
    return compiled  # type: ignore[no-any-return]


def _compile(compile: Callable[..., Any], files: Any, signature: Any) -> Any:
    with files.turns():
        return compile(signature)


def _rebuild_part(rebuild: Callable[..., Any], context: Any, kept: Any) -> Any:
    return rebuild(PartContext(context), kept)


def _keep(save: Callable[..., None], signature: Any, result: Any) -> None:
    """Save what was compiled; what numba has lost of it is used, and compiled anew by the next process.

    llvmlite finds a module that it has compiled in a set, which another thread may change at that moment when
    it drops a module: the object code is then not handed on.
    """
    try:
        save(signature, result)
    except RuntimeError as error:
        if not str(error).startswith("no compiled object yet"):
            raise


def _has(compiled: Any, name: str) -> bool:
    try:
        attrgetter(name)(compiled)
    except AttributeError:
        return False
    return True


def _compile_for_args(
    compiled: Any, compile_for_args: Callable[..., Any], known: set[Any], *arguments: Any
) -> Any:
    """Return the code for arguments: for read-only arrays that for arrays that can be written to.

    Their types differ, and each kernel would be compiled once more. Kernels write to what they are given to
    write to, and to nothing else.
    """
    with _little_garbage_sought():
        if not any(map(_has_locked, arguments)):
            return compile_for_args(*arguments)
        given = tuple(map(compiled.typeof_pyval, arguments))
        code = compiled.compile(tuple(map(_unlocked, given)))
    with _LOCK:
        if given not in known:
            known.add(given)
            compiled._insert([each._code for each in given], code, False)
    return code


_LOCK = Lock()
_compiling = 0  # calls that wait for code
_usual: tuple[int, ...] = ()  # Python's thresholds while none does


@contextmanager
def _little_garbage_sought() -> Iterator[None]:
    global _compiling, _usual
    with _LOCK:
        if _compiling == 0:
            _usual = gc.get_threshold()
            gc.set_threshold(max(_usual[0], MANY_OBJECTS) if _usual[0] else 0, *_usual[1:])
        _compiling += 1
    try:
        yield
    finally:
        with _LOCK:
            _compiling -= 1
            if _compiling == 0:
                gc.set_threshold(*_usual)


def _has_locked(argument: Any) -> bool:
    if isinstance(argument, np.ndarray):
        return not argument.flags.writeable
    return isinstance(argument, tuple) and any(map(_has_locked, argument))


def _unlocked(given: Any) -> Any:
    """Return the type of the same arguments if all arrays could be written to."""
    if isinstance(given, types.Array):
        return given.copy(readonly=False)
    if isinstance(given, types.BaseTuple):
        return types.BaseTuple.from_types(
            tuple(map(_unlocked, given.types)), getattr(given, "instance_class", None)
        )
    return given


def _call_template(resolve: Callable[..., Any], arguments: Any, keywords: Any) -> Any:
    """Choose what a call in a kernel compiles: one version for all numbers, not one for each constant.

    What is inlined gets its constants all the same.
    """
    keywords = {name: types.unliteral(each) for name, each in dict(keywords).items()}
    return resolve(tuple(types.unliteral(each) for each in arguments), keywords)
