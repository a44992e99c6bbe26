"""Compiled kernels, kept between runs until the source of any of them changes: ``njit`` and ``cfunc`` as in numba.

Numba's own cache looks at the file of a kernel alone: a kernel that calls a changed one of another file, or uses a
constant of it, would go on with the old code. Here the folder of the cache bears a hash of all files with kernels,
of the modules that they import and of the tables beside them: constants are frozen into compiled code.
"""

import ast
import hashlib
import os
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

HAS_KERNELS = re.compile(rb"^(from|import) (vipetsc\.compiled|numba)\b", re.MULTILINE)


@overload
def njit(function: Function, /) -> Function: ...
@overload
def njit(*signature: str, **options: Any) -> Callable[[Function], Function]: ...
def njit(*signature: Any, **options: Any) -> Any:
    """``numba.njit`` with a cache; without a signature, it compiles at the first call."""
    if signature and callable(signature[0]):
        return _decorator(numba.njit)(signature[0])
    return _decorator(numba.njit, *signature, **options)


def cfunc(signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.cfunc`` with a cache: a function that C code can call, at its ``address``."""
    return _decorator(numba.cfunc, signature, **options)


def _decorator(compiler: Any, *signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``compiler`` with ``kernel_cache`` as numba's folder meanwhile; a NUMBA_CACHE_DIR stays the parent."""

    def decorate(function: Callable[..., Any]) -> Any:
        config: Any = numba.config
        chosen = config.CACHE_DIR
        config.CACHE_DIR = str(kernel_cache(Path(__file__).parent, chosen))
        try:
            return compiler(*signature, cache=True, **options)(function)
        finally:
            config.CACHE_DIR = chosen

    return decorate


@cache
def kernel_cache(package: Path, chosen: str = "") -> Path:
    """The folder for the compiled kernels of ``package``, named by the hash of ``kernel_sources``.

    It is in ``chosen``, else in the package, else (a package that may not be written to) in the user's cache.
    """
    named = (str(path.relative_to(package)).encode() + b"\0" + path.read_bytes() for path in kernel_sources(package))
    digest = hashlib.sha256(b"".join(named)).hexdigest()
    parent = package / "__pycache__" if os.access(package, os.W_OK) else Path.home() / ".cache" / package.name
    return Path(chosen or parent) / f"kernels-{digest[:16]}"


def kernel_sources(package: Path) -> list[Path]:
    """The files of ``package`` with kernels, those that they import from it, and its tables of numbers."""
    sources = set(package.rglob("*.csv"))
    for path in package.rglob("*.py"):
        text = path.read_bytes()
        if HAS_KERNELS.search(text):
            sources.add(path)
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == package.name:
                    names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
                    files = (package.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names)
                    sources |= {file for file in files if file.exists()}
    return sorted(sources)


# Of functions that make no arrays but views: numba counts no references to theirs, which costs more than short sums do
# (each array of a tuple, at each access). ``inlined`` ones are put in place of their calls, with the constants there.
kernel = njit(error_model="numpy", _nrt=False)
inlined = njit(error_model="numpy", _nrt=False, inline="always")
allocating = njit(error_model="numpy", _nrt=True)  # makes arrays, also where it is called from those
