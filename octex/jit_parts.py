"""How numba's code is made with less work than by numba's own rules, for the same machine code or nearly.

numba optimizes a function by itself, then once more with all that it calls; and it makes machine code of
every function, also of those that are compiled into others and never called. Here the first is left out, and
*parts*, which only kernels call, are tidied up and kept as LLVM's code alone. And numba finds anew for each
instruction what is the same for all of its kind; here it is found once. All together: a third less time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import llvmlite.binding
from numba import types
from numba.core import compiler, ir, rewrites, typed_passes, untyped_passes
from numba.core.base import BaseContext
from numba.core.codegen import CPUCodegen, JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.types.functions import BaseFunction
from numba.np.ufunc.array_exprs import RewriteArrayExprs, _is_ufunc

_Passes = llvmlite.binding.newpassmanagers.ModulePassManager
_OF_LIBRARY = (
    *("_ensure_finalized", "_finalize_dynamic_globals", "_finalize_final_module", "_get_module_for_linking"),
    *("_optimize_final_module", "_optimize_functions", "get_pointer_to_function"),
    "serialize_using_object_code",
)
_OF_PASSES = (
    *("add_dead_code_elimination_pass", "add_global_dead_code_eliminate_pass"),
    *("add_instruction_combine_pass", "add_simplify_cfg_pass", "add_sroa_pass"),
)
#: What is used of numba and LLVM beyond what they document: of which classes, and its names.
USED = (
    (JITCodeLibrary, _OF_LIBRARY),
    (CPUCodegen, ("_pass_builder",)),
    (_Passes, _OF_PASSES),
    (compiler.Flags, ("values",)),
    (compiler.Compiler, ("_compile_core",)),
    (BaseFunction, ("get_call_type",)),
    (BaseContext, ("get_abi_sizeof", "get_function")),
    (ir.Inst, ("_rec_list_vars",)),
)


class Whole(JITCodeLibrary):  # type: ignore[misc]
    """The code of a kernel: optimized once, with all that it calls."""

    def _optimize_functions(self, module: Any) -> None:
        module.data_layout = self._codegen._data_layout


class Part(Whole):
    """The code of a part, of which there is no machine code."""

    @property
    def codegen(self) -> Any:
        """Where what belongs to machine code is set: nowhere."""
        return _Nowhere

    def _optimize_final_module(self) -> None:
        """Remove what is not needed; the rest is done in the kernels that this becomes part of."""
        passes = llvmlite.binding.create_new_module_pass_manager()
        passes.add_global_dead_code_eliminate_pass()
        passes.add_sroa_pass()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
        passes.add_dead_code_elimination_pass()
        passes.add_global_dead_code_eliminate_pass()
        passes.run(self._final_module, self._codegen._pass_builder())

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, _name: str) -> int:
        """Say that nothing can be called."""
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """Return what is kept on disk."""
        return self.name, "bitcode", self._get_module_for_linking().as_bitcode()


class _Nowhere:
    @staticmethod
    def set_env(_name: str, _environment: Any) -> None:
        """Set nothing: environments are for what calls Python."""


class _Flags(compiler.Flags):  # type: ignore[misc]
    """numba's options, which it compares with others for all that it looks up."""

    __slots__ = ()
    _defaults: ClassVar[dict[str, Any]] = compiler.Flags().values()
    _hash: ClassVar[int] = hash(compiler.Flags())  # all have the same

    def values(self) -> dict[str, Any]:
        """Return the options by name."""
        return {**self._defaults, **self._values}

    def __eq__(self, other: object) -> Any:
        return self.values() == other.values() if isinstance(other, compiler.Flags) else NotImplemented

    def __hash__(self) -> int:
        return self._hash


_PLAIN = types.Number, types.Boolean, types.Array, types.BaseTuple
_signatures: dict[Any, Any] = {}
_Functions: Any = BaseFunction
_Instructions: Any = ir.Inst
_find_signature: Any = getattr(BaseFunction, "get_call_type", None)
_find_variables: Any = getattr(ir.Inst, "_rec_list_vars", None)


def _signature_of(function: Any, context: Any, arguments: Any, keywords: Any) -> Any:
    """Return how numba's own ``function`` is called with types: numba tries one way after the other.

    Ways that are written in Python are compiled by other options, and not kept.
    """
    if keywords or not all(isinstance(each, _PLAIN) for each in arguments):
        return _find_signature(function, context, arguments, keywords)
    key = context, function, tuple(arguments)
    signature = _signatures.get(key)
    if signature is None:
        signature = _find_signature(function, context, arguments, keywords)
        if function.get_impl_key(signature) is function.typing_key:
            _signatures[key] = signature
    return signature


_WITHOUT_VARIABLES = {bool, int, float, str, type(None), ir.Loc}


def _variables_in(instruction: Any, value: Any) -> list[Any]:
    """Return the variables in a part of an instruction."""
    kind = type(value)
    if kind is ir.Var:
        return [value]
    if kind in _WITHOUT_VARIABLES:
        return []
    if kind not in (dict, list, tuple):
        return list(_find_variables(instruction, value))
    found = []
    for each in value.values() if kind is dict else value:
        kind = type(each)
        if kind is ir.Var:
            found.append(each)
        elif kind not in _WITHOUT_VARIABLES:
            found += _variables_in(instruction, each)
    return found


@contextmanager
def _found_once() -> Iterator[None]:
    """While the block lasts, numba finds as the functions above do; it compiles in one thread at a time."""
    with global_compiler_lock:
        before = _Functions.get_call_type, _Instructions._rec_list_vars
        _Functions.get_call_type, _Instructions._rec_list_vars = _signature_of, _variables_in
        try:
            yield
        finally:
            _Functions.get_call_type, _Instructions._rec_list_vars = before


@register_pass(mutates_CFG=True, analysis_only=False)
class _InlineClosureLikes(untyped_passes.InlineClosureLikes):  # type: ignore[misc]
    """numba's step for functions in functions and lists, where there are any."""

    _name = "octex_inline_closure_likes"

    def run_pass(self, state: Any) -> bool:
        """Return whether something may have been changed."""
        needed = any(each.value.op in ("build_list", "make_function") for each in _expressions(state))
        return needed and bool(super().run_pass(state))


@register_pass(mutates_CFG=True, analysis_only=False)
class _NopythonRewrites(typed_passes.NopythonRewrites):  # type: ignore[misc]
    """numba's step that makes one loop of several operations on arrays, where there are any."""

    _name = "octex_nopython_rewrites"

    def run_pass(self, state: Any) -> bool:
        """Return whether something may have been changed."""
        needed = any(_is_of_arrays(each, state.typemap) for each in _expressions(state))
        needed |= rewrites.rewrite_registry.rewrites["after-inference"] != [RewriteArrayExprs]
        return needed and bool(super().run_pass(state))


_STEPS = {
    untyped_passes.InlineClosureLikes: _InlineClosureLikes,
    typed_passes.NopythonRewrites: _NopythonRewrites,
}


def _expressions(state: Any) -> Iterator[Any]:
    """Yield what assigns an expression."""
    for block in state.func_ir.blocks.values():
        for each in block.body:
            if isinstance(each, ir.Assign) and isinstance(each.value, ir.Expr):
                yield each


def _is_of_arrays(assignment: Any, kinds: dict[str, Any]) -> bool:
    expression = assignment.value
    if expression.op == "call":
        return bool(_is_ufunc(getattr(kinds[expression.func.name], "typing_key", None)))
    return expression.op in ("binop", "unary") and isinstance(kinds[assignment.target.name], types.Array)


_sizes: dict[Any, int] = {}  # in bytes, of LLVM's types


def _remember(target: Any) -> None:
    """Let a function's own copy of numba's target find at once what it is asked for again and again."""
    get_function, get_size = target.get_function, target.get_abi_sizeof

    def function_of(name: Any, signature: Any, **how: Any) -> Any:
        # What makes an array of what is one: not there.
        if name == "__array__" and signature.args == (signature.return_type,):
            raise NotImplementedError
        return get_function(name, signature, **how)

    def size_of(kind: Any) -> int:
        if kind not in _sizes:
            _sizes[kind] = get_size(kind)
        return _sizes[kind]

    target.get_function, target.get_abi_sizeof = function_of, size_of


class _Compiler(compiler.Compiler):  # type: ignore[misc]
    _library: type[Whole]

    def __init__(
        self, typing: Any, target: Any, library: Any, arguments: Any, result: Any, flags: Any, local: Any
    ) -> None:
        super().__init__(typing, target, library, arguments, result, _Flags(flags), local)
        _remember(self.state.targetctx)

    def define_pipelines(self) -> list[Any]:
        """Return numba's steps, without those that find nothing to do."""
        pipelines: list[Any] = super().define_pipelines()
        for each in pipelines:
            each.passes = [(_STEPS.get(step, step), words) for step, words in each.passes]
        return pipelines

    def _compile_core(self) -> Any:
        with _found_once():
            return super()._compile_core()

    def compile_extra(self, function: Any) -> Any:
        library = self._library(self.state.targetctx.codegen(), function.__qualname__)
        library.enable_object_caching()
        self.state.library = library
        return super().compile_extra(function)


class WholeCompiler(_Compiler):
    """Compiles kernels."""

    _library = Whole


class PartCompiler(_Compiler):
    """Compiles parts."""

    _library = Part


class PartContext:
    """numba's target as code that was kept is read for it: as parts."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self.typing_context = context.typing_context
        self.get_executable = context.get_executable

    def codegen(self) -> PartContext:
        """Return what reads code that was kept."""
        return self

    def unserialize_library(self, data: Any) -> Part:
        """Read a part."""
        name, _, code = data
        part = Part(self._context.codegen(), name)
        part._final_module = llvmlite.binding.parse_bitcode(code)
        part._finalize_final_module()
        return part
