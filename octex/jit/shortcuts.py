"""numba's steps from Python to LLVM's code with less work, for the same code or nearly.

numba finds anew for each instruction what is the same for all of its kind; here it is found once. And it
keeps in memory what LLVM then turns into values, arrays and tuples of them above all; here they are values.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache, partial
from typing import Any, ClassVar

import llvmlite.ir as llvm
from numba import types
from numba.core import base, compiler, ir, lowering, rewrites, typed_passes, untyped_passes
from numba.core.analysis import compute_cfg_from_blocks, compute_use_defs, must_use_alloca
from numba.core.base import BaseContext
from numba.core.cgutils import pointer_add
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import PassManager, _pass_registry, register_pass
from numba.core.errors import WarningsFixer  # type: ignore[attr-defined]
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.transforms import canonicalize_cfg
from numba.core.types.functions import BaseFunction
from numba.core.typing.context import Context as TypingContext
from numba.cpython.builtins import do_minmax
from numba.extending import intrinsic
from numba.np.arrayobj import load_item, store_item
from numba.np.ufunc.array_exprs import RewriteArrayExprs, _is_ufunc

#: What is used of numba beyond what it documents: of which classes, and its names.
USED_OF_STEPS = (
    (compiler.Flags, ("values",)),
    (BaseFunction, ("get_call_type", "get_impl_key")),
    (BaseContext, ("get_abi_sizeof", "get_function")),
    (ir.Inst, ("_rec_list_vars",)),
    (PassManager, ("_runPass",)),
    (TypingContext, ("resolve_getattr",)),
    (base, ("_has_loc",)),
    (PostProcessor, ("run",)),
    (WarningsFixer, ("catch_warnings",)),
    (lowering.Lower, ("_find_singly_assigned_variable", "delvar", "lower_assign")),
)


class Flags(compiler.Flags):  # type: ignore[misc]
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


@intrinsic  # type: ignore[untyped-decorator]
def _whole(_context: Any, number: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.cast(builder, arguments[0], signature.args[0], signature.return_type)

    return (number if isinstance(number, types.Integer) else types.intp)(number), codegen


@intrinsic  # type: ignore[untyped-decorator]
def _least(context: Any, one: Any, other: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return do_minmax(context, builder, signature.args, arguments, operator.lt)

    return context.unify_types(one, other)(one, other), codegen


@intrinsic  # type: ignore[untyped-decorator]
def _largest(context: Any, one: Any, other: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return do_minmax(context, builder, signature.args, arguments, operator.gt)

    return context.unify_types(one, other)(one, other), codegen


#: What numba writes in Python and compiles for each type, and the same in LLVM's instructions: by the number
#: of numbers.
_DIRECT = {(int, 1): _whole, (min, 2): _least, (max, 2): _largest}
_REAL = types.Integer, types.Float
_PLAIN = types.Number, types.Boolean, types.Array, types.BaseTuple
_signatures: dict[Any, Any] = {}
_Functions: Any = BaseFunction
_Instructions: Any = ir.Inst
_Processors: Any = PostProcessor
_Warnings: Any = WarningsFixer
_Builders: Any = llvm.IRBuilder
_Contexts: Any = TypingContext
_base: Any = base
_find_signature: Any = getattr(BaseFunction, "get_call_type", None)
_find_variables: Any = getattr(ir.Inst, "_rec_list_vars", None)
_process: Any = getattr(PostProcessor, "run", None)
_extract: Any = _Builders.extract_value
_find_attribute: Any = getattr(TypingContext, "resolve_getattr", None)
_has_loc: Any = getattr(base, "_has_loc", None)


def _signature_of(function: Any, context: Any, arguments: Any, keywords: Any) -> Any:
    """Return how numba's own ``function`` is called with types: numba tries one way after the other.

    Ways that are written in Python are compiled by other options, and not kept.
    """
    if keywords or not all(isinstance(each, _PLAIN) for each in arguments):
        return _find_signature(function, context, arguments, keywords)
    direct = _DIRECT.get((function.typing_key, len(arguments)))
    if direct is not None and all(isinstance(each, _REAL) for each in arguments):
        of_direct, plain = context.resolve_value_type(direct), tuple(map(types.unliteral, arguments))
        signature = of_direct.get_call_type(context, plain, {})
        function._impl_keys[signature.args] = of_direct.get_impl_key(signature)
        return signature
    key = context, function, tuple(arguments)
    signature = _signatures.get(key)
    if signature is None:
        signature = _find_signature(function, context, arguments, keywords)
        if function.get_impl_key(signature) is function.typing_key:
            _signatures[key] = signature
    return signature


def _tidy_up(processor: Any, emit_dels: bool = False, **options: Any) -> None:
    """Tidy up a function's blocks after a step; how long variables live is found when it is needed."""
    function = processor.func_ir
    if emit_dels or function.is_generator:
        _process(processor, emit_dels, **options)
        return
    function.blocks = canonicalize_cfg(function.blocks)
    function.variable_lifetime = VariableLifetime(function.blocks)
    function.generator_info = None


def _as_they_are(_fixer: Any, **_place: Any) -> Any:
    """Let warnings pass, without the line of the source that they are about."""
    return nullcontext()


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


def _extracted(builder: Any, aggregate: Any, index: Any, name: str = "") -> Any:
    """Return a member of a structure: what was inserted there, where it is put together in sight."""
    indices = list(index) if isinstance(index, list | tuple) else [index]
    while indices:
        source = aggregate
        while isinstance(source, llvm.InsertValue) and source.indices != indices[:1]:
            if len(source.indices) > 1:
                return _extract(builder, aggregate, indices, name)
            source = source.aggregate
        if not isinstance(source, llvm.InsertValue):
            return _extract(builder, aggregate, indices, name)
        aggregate = source.value
        del indices[0]
    return aggregate


def _attribute_of(context: Any, kind: Any, name: str) -> Any:
    """Return the type of a type's attribute: functions cannot be called as objects."""
    if name == "__call__" and isinstance(kind, BaseFunction | types.Dispatcher):
        return None
    return _find_attribute(context, kind, name)


def _takes_place(function: Any) -> bool:
    """Tell whether numba's function takes the place in the source."""
    code = getattr(function, "__code__", None)
    if code is None or hasattr(function, "__wrapped__"):
        return bool(_has_loc(function))
    return "loc" in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]


_INSTEAD = (
    (_Contexts, "resolve_getattr", _attribute_of),
    (_base, "_has_loc", _takes_place),
    (_Builders, "extract_value", _extracted),
    (_Functions, "get_call_type", _signature_of),
    (_Instructions, "_rec_list_vars", _variables_in),
    (_Processors, "run", _tidy_up),
    (_Warnings, "catch_warnings", _as_they_are),
)


@contextmanager
def found_once() -> Iterator[None]:
    """While the block lasts, numba finds as the functions above do; it compiles in one thread at a time."""
    with global_compiler_lock:
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in _INSTEAD]
        for owner, name, function in _INSTEAD:
            setattr(owner, name, function)
        try:
            yield
        finally:
            for owner, name, function in before:
                setattr(owner, name, function)


class Steps(PassManager):  # type: ignore[misc]
    """numba's steps, one after the other; nobody is told."""

    def _runPass(self, _index: int, step: Any, state: Any) -> None:  # noqa: N802
        step.analysis = self._analysis
        changed = [step.run_initialization(state), step.run_pass(state), step.run_finalizer(state)]
        if any(changed) and _pass_registry.get(type(step)).mutates_CFG:
            PostProcessor(state.func_ir).run()


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


class _Lower(lowering.Lower):  # type: ignore[misc]
    """numba's step to LLVM, which keeps in memory all variables that several blocks use.

    Here are those that are assigned once, in a block that comes before all that use them, values.
    """

    def _find_singly_assigned_variable(self) -> None:
        blocks = self.func_ir.blocks
        places: dict[str, list[int]] = {}
        arguments = set()
        for place, block in blocks.items():
            for each in block.find_insts(ir.Assign):
                places.setdefault(each.target.name, []).append(place)
                if isinstance(each.value, ir.Arg) and not isinstance(
                    self.typeof(f"arg.{each.value.name}"), types.Omitted
                ):
                    arguments.add(each.target.name)
        lasting = {name for name, found in places.items() if len(found) == 1} - must_use_alloca(blocks)
        befores = compute_cfg_from_blocks(blocks).dominators()
        shared = set()
        for place, names in compute_use_defs(blocks).usemap.items():
            for name in names & lasting:
                (first,) = places[name]
                shared.add(name)
                if first >= place or first not in befores.get(place, ()):
                    lasting.remove(name)
        # Callers count references to arguments while a call lasts.
        self._borrowed = lasting & arguments
        counted = {name for name in lasting & shared if self._is_counted(name)}
        self._singly_assigned_vars = lasting - (counted - self._borrowed)
        self._blk_local_varmap: dict[str, Any] = {}

    def _is_counted(self, name: str) -> bool:
        """Tell whether references to what a variable holds are counted."""
        if not self.context.enable_nrt:
            return False
        return bool(self.context.data_model_manager[self.typeof(name)].contains_nrt_meminfo())

    def lower_assign(self, kind: Any, assignment: Any) -> Any:
        """Return what is assigned."""
        argument = assignment.value
        if assignment.target.name not in self._borrowed:
            return super().lower_assign(kind, assignment)
        given = self.typeof(f"arg.{argument.name}")
        return self.context.cast(self.builder, self.fnargs[argument.index], given, kind)

    def delvar(self, name: str) -> None:
        """Count a reference less, where they are counted."""
        if name not in self._borrowed and self._is_counted(name):
            super().delvar(name)


@register_pass(mutates_CFG=True, analysis_only=False)
class _NativeLowering(typed_passes.NativeLowering):  # type: ignore[misc]
    _name = "octex_native_lowering"

    @property
    def lowering_class(self) -> Any:
        """What does it."""
        return _Lower


@register_pass(mutates_CFG=False, analysis_only=True)
class _AnnotateTypes(typed_passes.AnnotateTypes):  # type: ignore[misc]
    """numba's step that writes the types beside the source, for people: left out."""

    _name = "octex_annotate_types"

    def run_pass(self, state: Any) -> bool:
        """Return whether something may have been changed."""
        state.type_annotation = ""
        return False


STEPS = {
    typed_passes.AnnotateTypes: _AnnotateTypes,
    untyped_passes.InlineClosureLikes: _InlineClosureLikes,
    typed_passes.NopythonRewrites: _NopythonRewrites,
    typed_passes.NativeLowering: _NativeLowering,
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


@cache
def _is_element(kind: Any, index: Any) -> bool:
    """Tell whether an index, or indices, name a number of an array."""
    if not isinstance(kind, types.Array) or kind.layout == "F" or not kind.aligned:
        return False
    indices = index.types if isinstance(index, types.BaseTuple) else (index,)
    if len(indices) != kind.ndim or not isinstance(kind.dtype, types.Number | types.Boolean):
        return False
    return all(isinstance(each, types.Integer) for each in indices)


def _place_of(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Return a pointer to an element. numba stores the array's seven fields, and loads them, each time."""
    kind, index, *_ = signature.args
    model = context.data_model_manager[kind]
    at = [arguments[1]]
    if isinstance(index, types.BaseTuple):
        at = [builder.extract_value(arguments[1], axis) for axis in range(kind.ndim)]
    kinds = index.types if isinstance(index, types.BaseTuple) else [index]

    def field(name: str, *axis: int) -> Any:
        return builder.extract_value(arguments[0], [model.get_field_position(name), *axis])

    total = None
    for axis, (each, number) in enumerate(zip(kinds, at, strict=True)):
        number = context.cast(builder, number, each, types.intp if each.signed else types.uintp)
        size = field("shape", axis) if each.signed or axis else None
        if each.signed:  # those below zero count from the end
            is_below = builder.icmp_signed("<", number, number.type(0))
            number = builder.select(is_below, builder.add(number, size), number)
        if kind.layout != "C":
            number = builder.mul(number, field("strides", axis))
        elif total is not None:
            total = builder.mul(total, size)
        total = number if total is None else builder.add(total, number)
    data = field("data")
    if kind.layout == "C":
        return builder.gep(data, [total])
    return pointer_add(builder, data, total)


def _get_element(context: Any, signature: Any, builder: Any, arguments: Any, _where: Any = None) -> Any:
    return load_item(context, builder, signature.args[0], _place_of(context, builder, signature, arguments))


def _set_element(context: Any, signature: Any, builder: Any, arguments: Any, _where: Any = None) -> None:
    kind, _, given = signature.args
    value = context.cast(builder, arguments[2], given, kind.dtype)
    store_item(context, builder, kind, value, _place_of(context, builder, signature, arguments))


_ELEMENT: dict[Any, Any] = {operator.getitem: _get_element, operator.setitem: _set_element}
_sizes: dict[Any, int] = {}  # in bytes, of LLVM's types


def remember(target: Any) -> None:
    """Let a function's own copy of numba's target find at once what it is asked for again and again."""
    get_function, get_size = target.get_function, target.get_abi_sizeof

    def function_of(name: Any, signature: Any, **how: Any) -> Any:
        # What makes an array of what is one: not there.
        if name == "__array__" and signature.args == (signature.return_type,):
            raise NotImplementedError
        of_element = _ELEMENT.get(getattr(name, "typing_key", None))
        if of_element and not target.enable_boundscheck and _is_element(*signature.args[:2]):
            return partial(of_element, target, signature)
        return get_function(name, signature, **how)

    def size_of(kind: Any) -> int:
        if kind not in _sizes:
            _sizes[kind] = get_size(kind)
        return _sizes[kind]

    target.get_function, target.get_abi_sizeof = function_of, size_of
