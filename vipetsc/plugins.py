"""Modules of users, which register parts (``vipetsc.register``): how they are located, imported and distinguished.

A module is named by a file ending in ``.py``, by an entry point of the group ``vipetsc.plugins``, or as Python imports
it, in this order, as pytest takes the name after ``-p``. What is installed is imported only where a case names it.
"""

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from vipetsc import register
from vipetsc.process import announce
from vipetsc.register import PARTS, PartError, RegisteredPart

GROUP = "vipetsc.plugins"  # of entry points
NEVER_RESULTS = (register.FIGURE,)  # kinds of parts on which no number depends
# Errors of a program rather than of its numbers: what is wrong with one run is wrong with all others. KeyError is among
# them, since functions of modules ask by name for what runs contain. IndexError is not, since lists may be empty in one
# run and not in the next. The last two are RuntimeErrors, which otherwise say that a run has failed.
PROGRAMMING: tuple[type[Exception], ...] = (
    TypeError,
    AttributeError,
    NameError,
    ImportError,
    SyntaxError,
    KeyError,
    NotImplementedError,
    RecursionError,
)


class PartFailure(PartError):
    """A part whose function fails for the numbers of one run, and may succeed for others."""


class PluginError(Exception):
    """A module that cannot be used; the message says why."""


@dataclass(frozen=True)
class Plugin:
    """An imported module: its ``name`` in a case, its ``version``, the Python ``modules`` that register its parts."""

    name: str
    version: str
    modules: frozenset[str]

    @property
    def parts(self) -> list[RegisteredPart]:
        """The parts of the module, by kind and name."""
        every = [part for parts in PARTS.values() for part in parts.values() if part.modules & self.modules]
        return sorted(every, key=lambda part: (part.kind, part.name))

    @property
    def sha256(self) -> str:
        """SHA-256 of the source on which results depend: of one file, else of the files' hashes; empty without any."""
        digests = sorted({part.sha256 for part in self.parts if part.kind not in NEVER_RESULTS})
        if len(digests) > 1:
            return sha256(" ".join(digests).encode()).hexdigest()
        return "".join(digests)


_PLUGINS: dict[str, Plugin] = {}
# A context variable rather than an argument: the types of keys need the names, and pydantic passes them no arguments.
_NAMED: ContextVar[tuple[str, ...] | None] = ContextVar("named", default=None)


@contextmanager
def only(names: Sequence[str]) -> Iterator[None]:
    """Let ``registered`` list, within the block, only parts of the modules ``names``, which are those of a case."""
    token = _NAMED.set(tuple(names))
    try:
        yield
    finally:
        _NAMED.reset(token)


def registered(kind: str) -> tuple[str, ...]:
    """Return names of the registered parts of a ``kind``: of the modules that the case at hand names, else of all."""
    named = _NAMED.get()
    if named is None:
        return tuple(PARTS[kind])
    plugins = [_PLUGINS[name] for name in named if name in _PLUGINS]
    return tuple(part.name for plugin in plugins for part in plugin.parts if part.kind == kind)


def call(part: RegisteredPart, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the value of a ``function`` of a ``part``, which is named before its first call.

    Raises PartError for errors of the program, and PartFailure for all others.
    """
    announce(f"calling the {part.kind} {part.name!r} of {part.file}")
    try:
        return function(*arguments)
    except Exception as error:
        text = f"the {part.kind} {part.name!r} of {part.file} fails: {_reason(error, part.file)}"
        if isinstance(error, PROGRAMMING):
            raise PartError(text) from error
        raise PartFailure(text) from error


def announce_parts(modules: Sequence[str]) -> None:
    """Name the parts of the ``modules`` of a case on which results depend, before other ranks than 0 call them.

    ``call`` names a part on rank 0 alone: a line of each rank would be too many.
    """
    for name in modules:
        for part in load(name).parts:
            if part.kind not in NEVER_RESULTS:
                announce(f"ranks call the {part.kind} {part.name!r} of {part.file}")


def number_of(part: RegisteredPart, value: Any, what: str = "value") -> float:
    """Return the real number that a function of a ``part`` has returned; raises PartError for any other ``value``.

    ``what`` names it in the message.
    """
    array = np.asarray(value)
    if array.ndim or array.dtype.kind not in "biuf":
        given = f"the {part.kind} {part.name!r} of {part.file} returns {value!r}"
        raise PartError(f"{given} as its {what}; a real number is needed")
    return float(array)


def is_file(name: str) -> bool:
    """Return whether the ``name`` of a module is that of a file."""
    return name.endswith(".py")


def located(name: str, folder: Path) -> str:
    """Return the ``name`` of a module, which for a file is its absolute path; a relative one begins at ``folder``.

    If the file is not there, for instance since results have been moved, another file of that name takes its place: in
    ``folder``, in the working directory, or the only one that this process has imported.
    """
    if not is_file(name):
        return name
    path = (folder / name).resolve()
    if path.is_file():
        return str(path)

    for place in (folder, Path()):
        moved = (place / path.name).resolve()
        if moved.is_file():
            return str(moved)
    imported = [other for other in _PLUGINS if is_file(other) and Path(other).name == path.name]
    if len(imported) == 1:
        return imported[0]
    return str(path)


def without_folders(table: dict[str, Any]) -> dict[str, Any]:
    """Return the ``table`` of a valid case in which files of modules have no folders: results are moved with them.

    Files of one name in two folders keep their paths.
    """
    section = table.get("plugins")
    if not isinstance(section, dict):
        return table

    modules = section.get("modules", [])
    files = [Path(name).name for name in modules if is_file(name)]
    short = {name: Path(name).name for name in modules if is_file(name) and files.count(Path(name).name) == 1}
    sources = {short.get(name, name): source for name, source in section.get("sources", {}).items()}
    return table | {"plugins": section | {"modules": [short.get(name, name) for name in modules], "sources": sources}}


def load(name: str) -> Plugin:
    """Import the module ``name`` once; raises PluginError if it fails, has changed since, or registers nothing."""
    plugin = _PLUGINS.get(name)
    if plugin is None:
        announce(f"importing {name}")
        plugin = _imported(name)
        _PLUGINS[name] = plugin

    for part in plugin.parts:
        if Path(part.file).is_file() and register.file_digest(part.file) != part.sha256:
            raise PluginError(f"{part.file} has changed since this process imported it; start Python anew")
    return plugin


def is_imported(name: str) -> bool:
    """Return whether the module ``name`` has been imported in this process."""
    return name in _PLUGINS


def _imported(name: str) -> Plugin:
    """Return the module ``name``, imported."""
    # Modules that register parts during this import belong to it: the module may import others.
    earlier = _every_module()
    entry: metadata.EntryPoint | None = None
    try:
        if is_file(name):
            module = _from_file(Path(name))
        else:
            entry = next(iter(metadata.entry_points(group=GROUP, name=name)), None)
            installed = name
            if entry:
                installed = entry.module
            module = importlib.import_module(installed)
    except PluginError:
        raise
    # SystemExit is raised by a script that ends its process and was named by mistake.
    except (Exception, SystemExit) as error:
        _forget(_every_module() - earlier)
        raise PluginError(f"cannot be imported: {_reason(error, name)}") from error

    # An earlier import may have executed the module already: then its parts are found by its name and its submodules'.
    within = {other for other in _every_module() if f"{other}.".startswith(f"{module.__name__}.")}
    added = _every_module() - earlier
    plugin = Plugin(name=name, version=_version(module, entry), modules=frozenset(within | added))
    if not plugin.parts:
        raise PluginError("registers nothing; see the chapter extend of the manual")
    return plugin


def _from_file(path: Path) -> ModuleType:
    """Return the module in a file, under a name of its own: files of one name in two folders are two modules."""
    if not path.is_file():
        raise PluginError(f"there is no file {path}, which registers parts of this case")
    name = f"vipetsc_plugin_{sha256(str(path).encode()).hexdigest()[:8]}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _every_module() -> set[str]:
    """Return the modules of Python that register parts."""
    return {module for parts in PARTS.values() for part in parts.values() for module in part.modules}


def _forget(modules: set[str]) -> None:
    """Remove the parts of ``modules``: one that failed halfway leaves none."""
    for parts in PARTS.values():
        for part in list(parts.values()):
            part.modules.difference_update(modules)
            if not part.modules:
                del parts[part.name]


def _reason(error: BaseException, file: str) -> str:
    """Return an ``error`` in one line, after the last line of ``file``, else of any file outside this package."""
    text = f"{type(error).__name__}: {error}".rstrip(": ").replace("\n", " ")
    ours = str(Path(__file__).parent)
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(ours)]
    frames = [frame for frame in frames if frame.filename == file] or frames[-1:]
    # Frames of Python's import machinery have a name in angle brackets instead of a file.
    if not frames or frames[-1].filename.startswith("<"):
        return text
    return f"{text} ({frames[-1].filename}, line {frames[-1].lineno})"


def _version(module: ModuleType, entry: metadata.EntryPoint | None) -> str:
    """Return the version that a module states, else that of its distribution; empty without one."""
    stated = getattr(module, "__version__", "")
    if stated:
        return str(stated)
    if entry is not None and entry.dist is not None:
        return entry.dist.version
    try:
        return metadata.version(module.__name__.partition(".")[0])
    except (metadata.PackageNotFoundError, ValueError):
        return ""
