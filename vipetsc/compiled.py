"""Compiled kernels, stored between runs until their sources change: ``njit`` and ``cfunc`` as in numba.

Numba's own cache checks only the file of a kernel: a kernel that calls a changed kernel of another file, or uses a
constant of it, would keep the old code. Here the name of the cache folder contains a hash of the kernel's file, of the
modules from which it uses kernels or constants, and of the tables of numbers, because compiled code contains constants.
"""

import hashlib
import logging
import os
import re
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys

from vipetsc.kernel import EntryCompiler, Kernel
from vipetsc.process import cache_folder, compiling, launched_rank, say

Function = TypeVar("Function", bound=Callable[..., Any])

logger = logging.getLogger(__name__)

PARENTS: set[Path] = set()  # folders in which kernels are stored
HAS_KERNELS = re.compile(rb"^(from|import) (vipetsc\.compiled|numba)\b", re.MULTILINE)
IMPORTS = re.compile(r"^[ \t]*from ([\w.]+) import (\([^)]*\)|.*)$", re.MULTILINE)
NAME = re.compile(r"\w+")


@overload
def njit(function: Function, /) -> Function: ...
@overload
def njit(*signature: str, **options: Any) -> Callable[[Function], Function]: ...
def njit(*signature: Any, **options: Any) -> Any:
    """``numba.njit`` with a cache; without a signature, a ``Kernel`` that is compiled at the first call."""
    if signature and callable(signature[0]):
        return njit()(signature[0])
    disjoint = options.pop("disjoint", False)
    # No C code calls these.
    compile_entry = _decorator(numba.njit, *signature, no_cfunc_wrapper=True, pipeline_class=EntryCompiler, **options)
    if signature:
        return compile_entry
    return lambda function: Kernel(function, compile_entry, options, disjoint)


def cfunc(signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.cfunc`` with a cache: a function that C code can call, at its ``address``."""
    return _decorator(numba.cfunc, signature, **options)


def users_function(function: Callable[..., Any]) -> Any:
    """A ``function`` of a user's module, compiled where it is called; nothing is kept of it between runs."""
    # One that the module has compiled itself has perhaps another model of errors.
    return numba.njit(error_model="numpy")(getattr(function, "py_func", function))


def c_address(function: Callable[..., Any], signature: str) -> int:
    """The address of a ``function`` as a C function, for the rest of this process; raises NumbaError."""
    callback = numba.cfunc(signature)(function)
    _CALLBACKS.append(callback)
    return int(callback.address or 0)


_CALLBACKS: list[Any] = []  # C functions that are called by their addresses, which keep nothing from being freed


def _decorator(compiler: Any, *signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``compiler`` with ``kernel_cache`` as numba's folder meanwhile; a NUMBA_CACHE_DIR stays the parent."""

    def decorate(function: Callable[..., Any]) -> Any:
        config: Any = numba.config
        chosen = config.CACHE_DIR
        file = Path(function.__code__.co_filename)
        folder = kernel_cache(Path(__file__).parent, file, chosen)
        PARENTS.add(folder.parent)
        config.CACHE_DIR = str(folder)
        # Callbacks and kernels with a signature are compiled here, others at their first call.
        if signature:
            compiling.start()
        keeps = _can_keep(folder.parent)
        try:
            compiled = compiler(*signature, cache=keeps, **options)(function)
            if keeps and not signature:
                compiled._cache = _KeptCode(function)
            return compiled
        finally:
            if signature:
                compiling.stop()
            config.CACHE_DIR = chosen

    return decorate


class _KeptCode(FunctionCache):
    """Machine code of a function that is compiled at its first call."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for a signature, or None; numba would first prepare to compile, which takes longer than to load."""
        # All that finished code needs: the functions by which it allocates.
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


class CompilerListener(event.Listener):
    """Measures the time in which numba compiles functions that are not in the cache, and reports it once."""

    def on_start(self, event: Any) -> None:
        """Begin to compile; a function that is called is compiled within."""
        compiling.start()
        function = event.data["dispatcher"].py_func
        # Functions of others, which numba compiles too, take their own time.
        if function.__module__.split(".")[0] == __package__:
            _announce()

    def on_end(self, event: Any) -> None:
        """End it."""
        compiling.stop()


@cache
def _announce() -> None:
    """Report once, on one rank, why the first run of a version takes some 20 s longer than the next."""
    # Where kernels cannot be kept, a warning has said that they are compiled at every start.
    if not launched_rank() and all(_can_keep(parent) for parent in PARENTS):
        say("vipetsc: compiling kernels (once, about 20 s)")


event.register("numba:compile", CompilerListener())


@cache
def kernel_cache(package: Path, file: Path, chosen: str = "") -> Path:
    """The folder for the compiled kernels of a ``file`` of ``package``, named by the hash of ``kernel_sources``.

    It is in ``chosen``, else in the package, else (a package that may not be written to) in the user's cache.
    """
    digest = hashlib.sha256()
    for path in sorted(kernel_sources(package, file)):
        digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())

    if chosen:
        parent = Path(chosen)
    elif os.access(package, os.W_OK):
        parent = package / "__pycache__"
    else:
        parent = cache_folder()
    return parent / f"kernels-{digest.hexdigest()[:16]}"


@cache
def _can_keep(parent: Path) -> bool:
    """Whether kernels can be written below ``parent``; prints a message if they cannot."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=parent).close()
    except OSError as error:
        # Once, on one rank: every command compiles for up to 20 s then.
        if not launched_rank():
            reason = error.strerror or error
            logger.warning(
                "vipetsc: compiling kernels at every start; the cache %s cannot be written: %s", parent, reason
            )
        return False
    return True


def kernel_sources(package: Path, file: Path) -> set[Path]:
    """Files that the kernels of ``file`` depend on: itself, the files that it imports, and the tables of ``package``.

    Where one of those has kernels too, the files that it imports are among them, and so on.
    """
    sources = set(_tables(package))
    waiting = [file]
    while waiting:
        path = waiting.pop()
        if path not in sources:
            sources.add(path)
            waiting += _imports(package, path)
    return sources


@cache
def _tables(package: Path) -> frozenset[Path]:
    """The tables of numbers in ``package``, which stand next to its modules; other folders hold what users read."""
    return frozenset(table for table in package.rglob("*.csv") if (table.parent / "__init__.py").exists())


@cache
def _imports(package: Path, path: Path) -> list[Path]:
    """The files of ``package`` that the file ``path`` imports; none if it has no kernels."""
    text = path.read_bytes()
    if not HAS_KERNELS.search(text):
        return []

    names = []
    # Not by Python's parser, which takes longer for all files with kernels than a short run does.
    for module, imported in IMPORTS.findall(text.decode("utf-8")):
        if module.split(".")[0] == package.name:
            # What is imported may be a module, or a name in one.
            names += [module, *(f"{module}.{name}" for name in NAME.findall(imported))]
    files = [package.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names]
    return [file for file in files if file.exists()]


# For functions that make no arrays but views: numba counts no references to theirs, which costs more than short sums do
# (each array of a tuple, at each access). ``inlined`` ones are put in place of their calls, with the constants there.
kernel = njit(error_model="numpy", _nrt=False)
# For loops over arrays of which none overlaps one that is written to: LLVM, which cannot know that, keeps sums in
# registers then, where it would store each one before it reads the next number. They keep their order and their bits.
disjoint = njit(error_model="numpy", _nrt=False, disjoint=True)
inlined = njit(error_model="numpy", _nrt=False, inline="always")
allocating = njit(error_model="numpy", _nrt=True)  # makes arrays, also where it is called from those
