"""The section ``[plugins]``: modules of the user's, which register laws, waveforms and other parts by name.

The resolved case records the version of each module and the SHA-256 of its source. Every result thus states them, and a
result that was begun with another source is not continued.
"""

import logging
from collections.abc import Mapping
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


class SourceTable(Section):
    """Source of a module, as the resolved case records it."""

    version: str = described("version of the module")
    sha256: str = described("SHA-256 hash of the source file; of several files, that of their hashes")


class PluginsTable(Section):
    """Modules that register parts: files (.py), entry points of the group `vipetsc.plugins`, or importable modules."""

    modules: list[str] = described(
        "modules that register laws, waveforms and other parts: Python files (.py; a relative path: in the"
        " folder of the case file, else in the current folder), entry points, or importable modules",
        [],
        min_length=1,
    )
    sources: dict[str, SourceTable] | None = described(
        "source of each module that registers more than figures, filled in", None
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


def with_sources(table: dict[str, Any]) -> tuple[dict[str, Any], list[Problem]]:
    """Return ``table`` with the sources of its modules, which are imported, and problems with importing them.

    A module that cannot be imported keeps the source that a resolved case records.
    """
    names = module_names(table)
    if not names:
        section = table.get("plugins")
        if isinstance(section, dict) and "modules" not in section:
            return table, [Problem("plugins.modules", None, "missing; name files or modules")]
        return table, []

    # Absolute paths, since results are read from other folders than the one in which they were computed.
    table = with_located(table, Path())
    recorded = _recorded(table["plugins"].get("sources"))
    sources: dict[str, dict[str, str]] = {}
    problems = []
    for number, name in enumerate(module_names(table)):
        before = recorded.get(name) or recorded.get(Path(name).name)
        try:
            now = _source(name)
        except plugins.PluginError as error:
            now = before
            problems.append(Problem(f"plugins.modules[{number + 1}]", names[number], str(error)))
        if now:
            sources[name] = now
        if now and before and now["sha256"] != before.get("sha256"):
            warn_once(f"{name} has changed since the case was resolved that used it")
    return table | {"plugins": table["plugins"] | {"sources": sources}}, problems


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


def missing_modules(table: PluginsTable) -> list[Problem]:
    """Return problems with importing the modules that a resolved case records, as on a rank that did not read it.

    A module is a problem if it is missing, or if its source is not the one recorded.
    """
    problems = []
    # A module that other ranks have imported may be missing on this one: the message names the rank.
    rank = launched_rank()
    where = ""
    if rank is not None:
        where = f"on rank {rank}: "
    recorded = table.sources or {}
    for number, name in enumerate(table.modules, 1):
        try:
            now = _source(name)
        except plugins.PluginError as error:
            problems.append(Problem(f"plugins.modules[{number}]", name, f"{where}{error}"))
            continue
        if now and name in recorded and recorded[name].sha256 != now["sha256"]:
            problems.append(Problem(f"plugins.modules[{number}]", name, "differs from rank to rank"))
    return problems


def changed_modules(table: PluginsTable) -> list[Problem]:
    """Return problems with modules of a resolved case that this process has imported, and that are others by now.

    Others that are missing are none: the case was read without them.
    """
    return [problem for problem in missing_modules(table) if plugins.is_imported(str(problem.value))]


def _source(name: str) -> dict[str, str] | None:
    """Return the record of the module ``name``; None if it registers figures alone. Raises PluginError."""
    plugin = plugins.load(name)
    if not plugin.sha256:
        return None
    return {"version": plugin.version, "sha256": plugin.sha256}


def _recorded(sources: Any) -> dict[str, dict[str, str]]:
    """Return the records in ``plugins.sources`` by their paths, and by the last parts of these, since files are moved.

    Files of one name in two folders have records by their paths alone.
    """
    if not isinstance(sources, dict):
        return {}
    # The check of types reports other entries.
    rows = {name: row for name, row in sources.items() if isinstance(row, dict)}
    files = [Path(name).name for name in rows]
    alone = {file: row for file, row in zip(files, rows.values(), strict=True) if files.count(file) == 1}
    return alone | rows


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
def warn_once(text: str) -> None:
    """Warn on one rank, and once for each ``text``, since a file's case is read many times."""
    if not launched_rank():
        logger.warning("vipetsc: %s", text)
