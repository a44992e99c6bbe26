"""A compiled function that is linked into every kernel that calls it, and has machine code only where Python calls it.

Numba optimises each function together with all that it calls, translates it into machine code, and gives it a wrapper
by which Python can call it. Its caller then links the optimised code and does the same again: what lies n calls deep is
optimised and translated n times, and most of it is never called by Python. A ``Kernel`` is passed to its callers as
code of LLVM that is not optimised. It is optimised once, as part of a kernel that Python calls, where the optimiser may
put it in place of its calls, as numba's would. The order of compilation changes no number.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

from llvmlite.binding import create_new_function_pass_manager
from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.lowering import Lower
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

from vipetsc.lowering import TupleLower


class _Library(JITCodeLibrary):
    """The code of a function, which is optimised as a whole once all that it calls is linked to it."""

    def add_llvm_module(self, module: Any) -> None:
        """Add a ``module`` of LLVM, after a pass that moves variables into registers and so makes the code shorter.

        Numba also optimises each function by itself. This takes as long as the optimisation of the whole kernel, and
        the kernel is no faster for it.
        """
        module.data_layout = self._codegen._data_layout
        builder = self._codegen._pass_builder()
        passes = create_new_function_pass_manager()
        passes.add_sroa_pass()
        for function in module.functions:
            passes.run(function, builder)
        self._final_module.link_in(module)


class _LinkedLibrary(_Library):
    """The code of a kernel and of those that it calls, neither optimised as a whole nor translated."""

    def finalize(self) -> None:
        """Gather the code of the kernels that are called; no more is needed to link this to a caller."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _EntryLowering(NativeLowering):
    """Lowering by ``TupleLower``."""

    _name = "entry_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        """The class that translates a function."""
        return TupleLower

    def run_pass(self, state: Any) -> bool:
        """Lower the function of ``state``."""
        if state.library is None:
            state.library = _Library(state.targetctx.codegen(), state.func_id.func_qualname)
            # For the machine code to be kept between runs.
            state.library.enable_object_caching()
        return super().run_pass(state)


@register_pass(mutates_CFG=True, analysis_only=False)
class _LinkedLowering(_EntryLowering):
    """Lowering by ``TupleLower`` to a ``_LinkedLibrary``."""

    _name = "linked_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower the function of ``state`` and register it with numba, for its callers to find."""
        library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library = library
        state.flags.no_compile = True
        super().run_pass(state)
        library.finalize()

        # Numba distinguishes functions by objects that Python can call. This object has no code, since ``Kernel``
        # never calls it.
        lowered = state["cr"]
        description = lowered.fndesc
        key = _dynfunc.make_function(
            description.lookup_module(), description.qualname.split(".")[-1], "", 0, lowered.env, (library,)
        )
        state.targetctx.insert_user_function(key, description, [library])
        state.reload_init.extend(library._reload_init)
        state["cr"] = lowered._replace(cfunc=key)
        return True


class _Flags(Flags):
    """Options of a compilation, compared by the dictionary of those that are set.

    Numba looks functions up by types and options, some hundred times a kernel, and reads and compares all its options
    each time, which takes a twentieth of the whole compilation.
    """

    # A class that defines ``__eq__`` alone has no hash.
    __hash__ = Flags.__hash__

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Flags):
            return NotImplemented
        return bool(self._values == other._values)


class EntryCompiler(CompilerBase):
    """Numba's compiler of functions that Python calls, with lowering by ``TupleLower``."""

    _lowering: type[NativeLowering] = _EntryLowering

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.state.flags = _Flags(self.state.flags)

    def define_pipelines(self) -> list[PassManager]:
        """The passes of numba, of which the lowering is replaced."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        kinds = [kind for kind, _ in passes.passes]
        passes.passes[kinds.index(NativeLowering)] = (self._lowering, "lowering of tuples by address")
        passes.finalize()
        return [passes]


class _LinkedCompiler(EntryCompiler):
    """The compiler of kernels for their callers, which link them."""

    _lowering = _LinkedLowering


class _DisjointCompiler(_LinkedCompiler):
    """The compiler of kernels whose arrays do not overlap."""

    def define_pipelines(self) -> list[PassManager]:
        """The passes of kernels, with the arrays' addresses marked so for LLVM."""
        self.state.flags.noalias = True
        return super().define_pipelines()


class Kernel(CPUDispatcher):
    """A function that kernels and Python can call; ``decorator`` compiles it for calls by Python, at the first one.

    A ``disjoint`` kernel takes arrays of which none overlaps one that it writes to.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        decorator: Callable[..., Any],
        options: dict[str, Any],
        disjoint: bool = False,
    ) -> None:
        # Kernels that call this one link it: neither Python nor C needs a wrapper of it.
        linked = {"nopython": True, "boundscheck": None, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        compiler: type[CompilerBase] = _LinkedCompiler
        if disjoint:
            compiler = _DisjointCompiler
        super().__init__(function, locals={}, targetoptions=options | linked, pipeline_class=compiler)
        self._decorator = decorator

    @cached_property
    def entry(self) -> Any:
        """The function as numba compiles it, with a wrapper and machine code of its own."""
        return self._decorator(self.py_func)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the function from Python."""
        return self.entry(*arguments, **named)
