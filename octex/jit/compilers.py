"""How kernels and the parts that only they call are compiled with less work than by numba's own rules.

numba optimizes a function by itself, then twice more with all that it calls; and it makes machine code of
every function, also of those that are compiled into others and never called. Here it is optimized once, and
*parts* are tidied up and kept as LLVM's code alone; numba's steps are those of `shortcuts`. Together: 45 %
less time.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import llvmlite.binding
import numba
from numba.core import compiler
from numba.core.codegen import CPUCodegen, JITCodeLibrary

from octex.jit.shortcuts import STEPS, USED_OF_STEPS, Flags, Steps, found_once, remember

#: Whether this numba is one whose own rules are known; a newer one goes by those.
IS_KNOWN = (0, 62) <= numba.version_info.short < (0, 69)

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
    (CPUCodegen, ("_module_pass_manager", "_pass_builder")),
    (_Passes, _OF_PASSES),
    (compiler.Compiler, ("_compile_core",)),
    *USED_OF_STEPS,
)


class Whole(JITCodeLibrary):  # type: ignore[misc]
    """The code of a kernel: optimized once, with all that it calls."""

    def _optimize_functions(self, module: Any) -> None:
        module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


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


class _Compiler(compiler.Compiler):  # type: ignore[misc]
    _library: type[Whole]

    def __init__(
        self, typing: Any, target: Any, library: Any, arguments: Any, result: Any, flags: Any, local: Any
    ) -> None:
        flags = Flags(flags) if IS_KNOWN else flags
        super().__init__(typing, target, library, arguments, result, flags, local)
        if IS_KNOWN:
            remember(self.state.targetctx)

    def define_pipelines(self) -> list[Any]:
        """Return numba's steps, without those that find nothing to do."""
        pipelines: list[Any] = super().define_pipelines()
        for each in pipelines if IS_KNOWN else ():
            each.__class__ = Steps
            each.passes = [(STEPS.get(step, step), words) for step, words in each.passes]
        return pipelines

    def _compile_core(self) -> Any:
        with found_once() if IS_KNOWN else nullcontext():
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
