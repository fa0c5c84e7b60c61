"""How numba's code is made with less work than by numba's own rules, for the same machine code or nearly.

numba optimizes a function by itself, then once more with all that it calls; and it makes machine code of
every function, also of those that are compiled into others and never called. Here the first is left out, and
*parts*, which only kernels call, are kept as LLVM's code alone: a tenth of the time less.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding
from numba.core import compiler
from numba.core.codegen import JITCodeLibrary

#: What is used of numba's libraries and compilers beyond what it documents.
USED_OF_LIBRARY = (
    *("_ensure_finalized", "_finalize_dynamic_globals", "_finalize_final_module", "_get_module_for_linking"),
    *("_optimize_functions", "get_pointer_to_function", "serialize_using_object_code"),
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
