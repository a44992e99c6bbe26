"""A compiled function that is linked into every kernel that calls it, and has machine code only where Python calls it.

Numba optimises each function together with all that it calls, translates it into machine code, and gives it a wrapper
by which Python can call it. Its caller then links the optimised code and does the same again: what lies n calls deep is
optimised and translated n times, and most of it is never called by Python. A ``Kernel`` comes to its callers as it was
lowered. It is optimised once, as part of a kernel that Python calls, and the optimiser may put it in place of its
calls there as before. The order of compilation changes no number.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

from numba import _dynfunc  # type: ignore[attr-defined]
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering


class _LinkedLibrary(JITCodeLibrary):
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
class _LinkedLowering(NativeLowering):
    """Lowering to a ``_LinkedLibrary``."""

    _name = "linked_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower the function of ``state`` and register it with numba, for its callers to find."""
        library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library = library
        state.flags.no_compile = True
        super().run_pass(state)
        library.finalize()

        # Numba tells functions by objects that Python could call. This one has no code: ``Kernel`` never calls it.
        lowered = state["cr"]
        description = lowered.fndesc
        key = _dynfunc.make_function(
            description.lookup_module(), description.qualname.split(".")[-1], "", 0, lowered.env, (library,)
        )
        state.targetctx.insert_user_function(key, description, [library])
        state.reload_init.extend(library._reload_init)
        state["cr"] = lowered._replace(cfunc=key)
        return True


class _LinkedCompiler(CompilerBase):
    """Numba's compiler with the lowering above."""

    def define_pipelines(self) -> list[PassManager]:
        """The passes of numba, of which the last but one is replaced."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        kinds = [kind for kind, _ in passes.passes]
        passes.passes[kinds.index(NativeLowering)] = (_LinkedLowering, "linked lowering")
        passes.finalize()
        return [passes]


class Kernel(CPUDispatcher):
    """A function that kernels and Python can call; ``decorator`` compiles what Python calls."""

    def __init__(self, function: Callable[..., Any], decorator: Callable[..., Any], options: dict[str, Any]) -> None:
        linked = {"nopython": True, "boundscheck": None, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        super().__init__(function, locals={}, targetoptions=options | linked, pipeline_class=_LinkedCompiler)
        self._decorator = decorator

    @cached_property
    def entry(self) -> Any:
        """The function as numba compiles it, with a wrapper and machine code of its own."""
        return self._decorator(self.py_func)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call it from Python."""
        return self.entry(*arguments, **named)
