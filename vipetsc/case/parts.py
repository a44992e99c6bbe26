"""The section ``[plugins]``: modules of the user's, which register laws, waveforms and other parts by name.

The resolved case records every part on which numbers depend, with the version of its module and the SHA-256 of its
source. Every result thus states them, and a result that was begun with another source is not continued.
"""

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from vipetsc import plugins, register
from vipetsc.case.section import Problem, Section, described
from vipetsc.process import launched_rank
from vipetsc.register import RegisteredPart

logger = logging.getLogger(__name__)
PHYSICS = (register.LAW, register.DISSIPATION, register.WAVEFORM)  # kinds without which a case has no meaning
NAMING = ("contacts", "drive", "sweep")  # sections whose keys may name a part


class PartTable(Section):
    """A part that a module registers, as the resolved case records it."""

    module: str = described("module that registers the part")
    version: str = described("version of the module")
    sha256: str = described("SHA-256 hash of the source file")


class PluginsTable(Section):
    """Modules that register parts: files (.py), entry points of the group `vipetsc.plugins`, or importable modules."""

    modules: list[str] = described(
        "modules that register laws, waveforms and other parts: Python files (.py; a relative path: in the"
        " folder of the case file, else in the current folder), entry points, or importable modules",
        [],
        min_length=1,
    )
    parts: dict[str, dict[str, PartTable]] | None = described(
        "parts that the modules register, by kind and name, filled in", None
    )


@dataclass(frozen=True)
class PartName:
    """Type of a key whose value names a part of a ``kind``: a ``shipped`` one, or one of the modules of the case."""

    kind: str
    shipped: tuple[str, ...]

    @property
    def choices(self) -> tuple[str, ...]:
        """The names that the key may have."""
        return (*self.shipped, *plugins.registered(self.kind))

    def _check(self, value: Any) -> str:
        # Looked up at each check, since the modules of a case register their names after this class was made.
        if isinstance(value, str) and value in self.choices:
            return value
        names = [repr(name) for name in self.choices]
        expected = f"{', '.join(names[:-1])} or {names[-1]}"
        # The type and the words of pydantic's own error for a choice among names, which messages are made of.
        message = "Input should be {expected}; other names come from modules listed in plugins.modules"
        raise PydanticCustomError("literal_error", message, {"expected": expected})

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the check of a value; names are looked up when it is called."""
        return core_schema.no_info_plain_validator_function(self._check)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Return the names at this moment."""
        return {"enum": list(self.choices), "type": "string"}


def module_names(table: Mapping[str, Any]) -> list[str]:
    """Return the modules that the ``table`` of a case names; [] if the key is missing or invalid."""
    section = table.get("plugins")
    if not isinstance(section, dict):
        return []
    # Types are not checked yet: anything may be here, and that check reports what is wrong.
    names = section.get("modules")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return []
    return names


def relative_modules(table: Mapping[str, Any]) -> list[str]:
    """Return the relative names of files among the modules that the ``table`` of a case names."""
    return [name for name in module_names(table) if plugins.is_file(name) and not Path(name).is_absolute()]


def with_located(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return ``table`` with absolute paths of modules' files, which a case file in ``folder`` names."""
    names = module_names(table)
    if not names:
        return table
    return table | {"plugins": table["plugins"] | {"modules": [_located(name, folder) for name in names]}}


def _located(name: str, folder: Path) -> str:
    """Return the ``name`` of a module as `vipetsc.plugins.located` gives it; as it is if no file can have this name."""
    try:
        return plugins.located(name, folder)
    # A name that is too long, links that lead to each other, or a NUL. The import of the module reports it.
    except (OSError, RuntimeError, ValueError):
        return name


def with_parts(table: dict[str, Any]) -> tuple[dict[str, Any], list[Problem]]:
    """Return ``table`` with a record of the parts of its modules, which are imported, and what is wrong with them.

    If a resolved case does not need a module for its physics, the module may be missing: a warning says so, and the
    record stays as it is.
    """
    names = module_names(table)
    if not names:
        section = table.get("plugins")
        if isinstance(section, dict) and "modules" not in section:
            return table, [Problem("plugins.modules", None, "missing; name files or modules")]
        return table, []

    # Absolute paths, since results are read from other folders than the one in which they were computed.
    table = with_located(table, Path())
    earlier = table["plugins"].get("parts")
    recorded: dict[str, Any] = {}
    if isinstance(earlier, dict):
        recorded = earlier

    parts: dict[str, dict[str, Any]] = {}
    problems = []
    for number, name in enumerate(module_names(table)):
        try:
            rows = _record(name)
        except plugins.PluginError as error:
            # The record of an earlier reading takes the place of a module that is missing.
            rows = _rows_of(recorded, name)
            if earlier is None or any(kind in PHYSICS and part in _texts(table) for kind, part, _ in rows):
                problems.append(Problem(f"plugins.modules[{number + 1}]", names[number], str(error)))
            else:
                _warn(f"{name}: {error}; its parts are left out")
        for kind, part, row in rows:
            parts.setdefault(kind, {})[part] = row

    changed: dict[str, list[str]] = {}
    for kind, part, row in _all_rows(recorded):
        now = parts.get(kind, {}).get(part)
        if now and now.get("sha256") != row.get("sha256"):
            changed.setdefault(now["module"], []).append(f"{kind} {part}")
    # One warning for each module, which lists its parts.
    for name, which in changed.items():
        _warn(f"{name} has changed since the case was resolved that used it: {', '.join(which)}")
    return table | {"plugins": table["plugins"] | {"parts": parts}}, problems


def parts_in_use(table: Mapping[str, Any]) -> list[tuple[plugins.Plugin, RegisteredPart]]:
    """Return pairs of a module and a part that a resolved case uses: parts that it names, and all measures and figures.

    A module that is missing is left out: results can be read without its measures and figures.
    """
    texts = _texts(table)
    used = []
    for name in module_names(table):
        try:
            plugin = plugins.load(name)
        except plugins.PluginError:
            continue
        for part in plugin.parts:
            # A module may register several laws, of which the case uses one.
            if part.kind not in PHYSICS or part.name in texts:
                used.append((plugin, part))
    return used


def missing_parts(table: PluginsTable) -> list[Problem]:
    """Return problems with importing the modules that a resolved case records, as on a rank that did not read it.

    A module is a problem if it is missing, or if its source is not the one recorded.
    """
    problems = []
    # A module that other ranks have imported may be missing on this one: the message names the rank.
    rank = launched_rank()
    where = ""
    if rank is not None:
        where = f"on rank {rank}: "
    for number, name in enumerate(table.modules, 1):
        try:
            rows = _record(name)
        except plugins.PluginError as error:
            problems.append(Problem(f"plugins.modules[{number}]", name, f"{where}{error}"))
            continue
        for kind, part, row in rows:
            recorded = (table.parts or {}).get(kind, {}).get(part)
            if recorded and recorded.sha256 != row["sha256"]:
                problems.append(Problem(f"plugins.modules[{number}]", name, "differs from rank to rank"))
                break
    return problems


def _record(name: str) -> list[tuple[str, str, dict[str, str]]]:
    """Return kind, name and record of the parts of the module ``name`` on which numbers depend; raises PluginError."""
    plugin = plugins.load(name)
    rows = []
    for part in plugin.parts:
        if part.kind not in plugins.NEVER_RESULTS:
            row = {"module": name, "version": plugin.version, "sha256": part.sha256}
            rows.append((part.kind, part.name, row))
    return rows


def _all_rows(recorded: Mapping[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield kind, name and record of all parts in ``plugins.parts``; the check of types reports other entries."""
    for kind, parts in recorded.items():
        if not isinstance(parts, dict):
            continue
        for part, row in parts.items():
            if isinstance(row, dict):
                yield kind, part, row


def _rows_of(recorded: Mapping[str, Any], name: str) -> list[tuple[str, str, dict[str, Any]]]:
    """Return kind, name and record of the parts of the module ``name`` in ``plugins.parts``."""
    # Only the last part of the path counts: the file may have been recorded in another folder.
    return [row for row in _all_rows(recorded) if Path(str(row[2].get("module"))).name == Path(name).name]


def _texts(table: Mapping[str, Any]) -> set[str]:
    """Return all texts in the sections of a case that may name parts."""
    texts = set()
    waiting = [table.get(section) for section in NAMING]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, list):
            waiting += value
        elif isinstance(value, str):
            texts.add(value)
    return texts


@cache
def _warn(text: str) -> None:
    """Warn on one rank, and once for each ``text``, since a file's case is read many times."""
    if not launched_rank():
        logger.warning("vipetsc: %s", text)
