"""Compiled kernels, stored between runs until their sources change: ``njit`` and ``cfunc`` as in numba."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
from llvmlite.binding import parse_assembly
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.runtime import rtsys

from vipetsc.kernel import EntryCompiler, Kernel
from vipetsc.kernel_cache import ByContent, can_keep, kernel_cache, remove_oldest
from vipetsc.process import compiling, launched_rank, say

Function = TypeVar("Function", bound=Callable[..., Any])

PARENTS: set[Path] = set()  # folders in which kernels are stored


@overload
def njit(function: Function, /) -> Function: ...
@overload
def njit(*signature: str, **options: Any) -> Callable[[Function], Function]: ...
def njit(*signature: Any, **options: Any) -> Any:
    """``numba.njit`` with a cache; without a signature, a ``Kernel`` that is compiled at the first call."""
    if signature and callable(signature[0]):
        return njit()(signature[0])
    disjoint = options.pop("disjoint", False)
    # No C code calls these functions: the wrapper that it would need is not compiled.
    compile_entry = _decorator(numba.njit, *signature, no_cfunc_wrapper=True, pipeline_class=EntryCompiler, **options)
    if signature:
        return compile_entry
    return lambda function: Kernel(function, compile_entry, options, disjoint)


def cfunc(signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.cfunc`` with a cache: a function that C code can call, at its ``address``."""
    return _decorator(numba.cfunc, signature, **options)


def users_function(function: Callable[..., Any]) -> Any:
    """A ``function`` of a user's module, compiled where it is called; nothing is kept of it between runs."""
    # A function that the module itself has compiled may raise at a division by zero, which gives inf here.
    return numba.njit(error_model="numpy")(getattr(function, "py_func", function))


def c_address(function: Callable[..., Any], signature: str) -> int:
    """The address of a ``function`` as a C function, for the rest of this process; raises NumbaError."""
    callback = numba.cfunc(signature)(function)
    _CALLBACKS.append(callback)
    return int(callback.address or 0)


_CALLBACKS: list[Any] = []  # C functions in use: an address alone does not keep Python from freeing the function


def _decorator(compiler: Any, *signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: compiles functions by numba's ``compiler``, and keeps their code in the folder ``kernel_cache``.

    That folder lies within NUMBA_CACHE_DIR, if the user has set it.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        # Numba takes its folder from the configuration, which is changed for this function alone: functions of other
        # packages keep their own cache.
        config: Any = numba.config
        chosen = config.CACHE_DIR
        locators = config.CACHE_LOCATOR_CLASSES
        file = Path(function.__code__.co_filename)
        folder = kernel_cache(Path(__file__).parent, file, chosen)
        PARENTS.add(folder.parent)
        config.CACHE_DIR = str(folder)
        config.CACHE_LOCATOR_CLASSES = f"{ByContent.__module__}.{ByContent.__name__}"

        # Callbacks and kernels with a signature are compiled here, others at their first call.
        if signature:
            compiling.start()
        keeps = can_keep(folder.parent)
        try:
            compiled = compiler(*signature, cache=keeps, **options)(function)
            if keeps and not signature:
                compiled._cache = _KeptCode(function)
            return compiled
        finally:
            if signature:
                compiling.stop()
            config.CACHE_DIR = chosen
            config.CACHE_LOCATOR_CLASSES = locators

    return decorate


class _MachineCode(CompileResultCacheImpl):
    """What is stored of a function that Python calls: its machine code, without what numba stores for its callers."""

    def reduce(self, cres: Any) -> Any:
        """Numba's tuple for a function, without the code of LLVM, and with the environments that are used.

        From the code of LLVM other kernels could link the function, and numba would read it at each start; kernels link
        each other as ``Kernel`` says instead. Numba also stores an environment for every function that was linked into
        this one, and would import the modules of all of them at each start. Few functions ever read theirs.
        """
        (name, kind, (machine_code, _)), description, *parts, environments = super().reduce(cres)
        # Numba reads from the code of LLVM which functions there are. Python calls only the wrapper.
        entry = parse_assembly(f'define void @"{description.llvm_cpython_wrapper_name}"() {{ ret void }}')

        # Each environment is named where it is declared, and where it is read.
        code = cres.library.get_llvm_str()
        used = tuple(environment for environment in environments if code.count(environment.env_name) > 1)
        return (name, kind, (machine_code, entry.as_bitcode())), description, *parts, used


class _KeptCode(FunctionCache):
    """Machine code of a function that is compiled at its first call."""

    _impl_class = _MachineCode

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for a signature, or None; numba would first prepare to compile, which takes longer than to load."""
        # All that finished code needs: the functions by which it allocates.
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the code for a signature."""
        super().save_overload(sig, data)
        remove_oldest(Path(self.cache_path).parent)


class CompilerListener(event.Listener):
    """Measures the time in which numba compiles functions that are not in the cache, and reports it once."""

    def on_start(self, event: Any) -> None:
        """Start the clock; functions that this one calls are compiled before it ends."""
        compiling.start()
        function = event.data["dispatcher"].py_func
        # The time that is announced is that of this package's functions; numba compiles those of others too.
        if function.__module__.split(".")[0] == __package__:
            _announce()

    def on_end(self, event: Any) -> None:
        """Stop the clock."""
        compiling.stop()


@cache
def _announce() -> None:
    """Report once, on one rank, why the first run of a version takes some 20 s longer than the next."""
    # Where kernels cannot be kept, a warning has said that they are compiled at every start.
    if not launched_rank() and all(can_keep(parent) for parent in PARENTS):
        say("vipetsc: compiling kernels (once, about 20 s)")


event.register("numba:compile", CompilerListener())


# For functions that make views of arrays, but no arrays. Without ``_nrt`` numba counts no references to arrays, which
# would take longer than a short sum: each array of a tuple is counted at each access.
kernel = njit(error_model="numpy", _nrt=False)
# For loops over arrays of which none overlaps one that is written to. LLVM cannot see that, and would store each sum
# before it reads the next number; if it is told so, it keeps sums in registers. Sums keep their order and their bits.
disjoint = njit(error_model="numpy", _nrt=False, disjoint=True)
# For short functions that numba puts in place of their calls, with the constants that are passed there.
inlined = njit(error_model="numpy", _nrt=False, inline="always")
# For functions that make arrays; functions of the other kinds may call them.
allocating = njit(error_model="numpy", _nrt=True)
