"""How a case is read: from a TOML file, from changes by ``--set``, or from values in a program, into typed sections.

A table is read from a file, whose relative names of files are made absolute, or from values in a program (``plain``).
``--set`` changes its keys by their paths (``put``), and ``read_section`` reads each of its sections. All problems are
reported at once: a key that is unknown, of the wrong type or impossible becomes a ``Problem`` with the key's path, the
value, what to do and, where there is one, the nearest valid key.

A case file and the data that it reads are moved and copied together. A relative name is therefore that of a file in the
folder of the case file, or if there is none, of a file in the current folder. A name that is given by ``--set`` or in
code is looked up in the current folder alone.
"""

import copy
import math
import os
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ValidationError

from vipetsc.case.parts import with_located
from vipetsc.case.section import MARK, CaseError, Problem, Section, is_within, table_of, unit_at
from vipetsc.wording import nearest

# Magnitude of a number in a case. A product of six is at most 1e300, and one of six of the smallest at least 1e-300:
# both are ordinary numbers, while products of seven overflow or vanish.
LARGEST = 1e50
ITEM = re.compile(r"(.+)\[([1-9]\d*)\]")  # an entry of a list, as in masses[2]
# Keys that name a file: `lattice.cell.matrices`, `drive.samples.file` and `initial.path`, which sweeps and searches may
# vary, and the `file` of `identify.records`.
SECTIONS_WITH_FILES = "lattice", "drive", "initial", "sweep", "optimise", "identify"
KEYS_OF_FILES = "matrices", "file", "path"
MISSING = "no such file, neither in the folder of the case file nor in the current one"
Table = dict[str, Any]  # a parsed TOML table
AnySection = TypeVar("AnySection", bound=Section)


def read_toml(path: str | Path) -> Table:
    """Return the table in a TOML file, named after the file if it has no name, with absolute names of files.

    Raises CaseError.
    """
    sys.audit("vipetsc.read", str(path))
    path = Path(path)
    try:
        # utf-8-sig: editors on Windows begin files with a byte order mark, which TOML does not allow.
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise CaseError([Problem(str(path), None, f"{error.strerror}; a case file (TOML) is needed")]) from None
    except ValueError as error:
        raise CaseError([Problem(str(path), None, f"not a TOML file ({error})")]) from None
    table = {"name": path.stem} | parsed(text, str(path))
    try:
        return with_located(with_absolute_names(table, path.parent), path.parent)
    except RecursionError as error:
        raise CaseError([Problem(str(path), None, f"tables are nested too deeply ({error})")]) from None


def parsed(text: str, source: str) -> Table:
    """Return the table that a ``text`` in TOML is; raises CaseError, with the ``source`` of the text as its key."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise CaseError([Problem(source, None, f"not a TOML file ({error})")]) from None


def with_absolute_names(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a copy of the ``table`` of a case file in ``folder``, in which names of files are absolute."""

    def absolute(value: Any, key: str) -> Any:
        if isinstance(value, dict):
            # A sweep may write a key as "initial.path", in quotes.
            return {inner: absolute(item, inner.rpartition(".")[2]) for inner, item in value.items()}
        if isinstance(value, list):
            return [absolute(item, key) for item in value]
        if key in KEYS_OF_FILES and isinstance(value, str):
            return _absolute_name(value, folder)
        return value

    return table | {section: absolute(table[section], section) for section in SECTIONS_WITH_FILES if section in table}


def relative_names(table: dict[str, Any]) -> list[str]:
    """Yield the relative names of files in the ``table`` of a case file, in its order."""

    def names(value: Any, key: str) -> Iterator[str]:
        if isinstance(value, dict):
            for inner, item in value.items():
                yield from names(item, inner.rpartition(".")[2])
        elif isinstance(value, list):
            for item in value:
                yield from names(item, key)
        elif key in KEYS_OF_FILES and isinstance(value, str) and not Path(value).is_absolute():
            yield value

    return [name for section in SECTIONS_WITH_FILES for name in names(table.get(section), section)]


def _absolute_name(name: str, folder: Path) -> str:
    """Return the ``name`` of a file of ``folder``, or of the current folder; as it is where neither has the file."""
    path = Path(name)
    # The folder of the case file first: a case that is moved with its data must not find other data of the same name.
    for place in (folder, Path()):
        # ``Path.is_file`` would raise for a name that is too long for the system.
        if os.path.isfile(place / path):
            return str((place / path).absolute())
    return name


def plain_table(table: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return ``table`` in the types of TOML; a value None is a key that is not given.

    Tuples and arrays become lists, numbers of numpy those of Python, paths text, and sections of a case tables.
    """
    return {key: plain(value) for key, value in table.items() if value is not None}


def plain(value: Any) -> Any:
    """Return ``value`` in the types of TOML; one without such a type stays as it is, and is refused when it is read."""
    if isinstance(value, BaseModel):
        return value.model_dump(by_alias=True, exclude_none=True)
    if isinstance(value, Mapping):
        return plain_table(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple | range):
        return [plain(item) for item in value]
    if isinstance(value, PurePath):
        return str(value)
    return value


def wrong_keys(value: Any, path: str = "") -> Iterator[Problem]:
    """Yield the problems of keys anywhere in ``value`` that are not text."""
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                yield Problem(path or "case", key, "is not a key: keys are text")
            yield from wrong_keys(item, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list):
        for i, item in enumerate(value, 1):
            yield from wrong_keys(item, f"{path}[{i}]")


def with_overrides(table: dict[str, Any], overrides: Iterable[str]) -> tuple[dict[str, Any], list[Problem]]:
    """Return a copy of ``table`` with each ``section.key=value`` set (TOML value or bare word), and the problems.

    ``section.key=`` removes the key.
    """
    # The table may be the built-in one, which later cases read too.
    table = copy.deepcopy(table)
    problems: list[Problem] = []
    for override in overrides:
        path, equals, text = (part.strip() for part in override.partition("="))
        keys = path.split(".")
        value = value_of(text)

        if not equals or not all(keys):
            problems.append(Problem("--set", override, "write section.key=value"))
        elif has_more_keys(text):
            problems.append(
                Problem("--set", override, "gives a single key; give the keys in further lines with a --set each")
            )
        else:
            problems += [replace(p, key=f"--set {p.key}") for p in put(table, path, value)]
    return table, problems


def has_more_keys(text: str) -> bool:
    """Return whether further lines of a value's ``text`` are keys or sections of TOML."""
    try:
        return len(tomllib.loads(f"value = {text}")) > 1
    except (ValueError, RecursionError):
        return False


def value_of(text: str) -> Any:
    """Return the value written in ``text``: TOML, a number such as .5, or a bare word; None if ``text`` is empty."""
    try:
        # TOML first, which distinguishes lists, tables, booleans and quoted text.
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        pass
    try:
        # TOML allows neither .5 nor 5. as a number.
        return float(text)
    except ValueError:
        return text or None


def put(table: dict[str, Any], path: str, value: Any) -> list[Problem]:
    """Set the key ``path`` of ``table`` in place, or remove it (None); returns the problem if this fails.

    A path is "a.b.c", or "a.b[2].c" with an entry of a list, counted from 1. A key of the table may have dots itself.
    """
    place: Any = table
    added: tuple[dict[str, Any], str] | None = None
    key, rest = _divided(place, path)
    while rest:
        if added is None and isinstance(place, dict) and key not in place:
            added = place, key
        place = _below(place, key, put_missing=True)
        key, rest = _divided(place, rest)

    problems = _put(place, key, path, value)
    # A section that was made for the key has no place without it.
    if problems and added is not None:
        parent, section = added
        parent.pop(section, None)
    return problems


def _put(place: Any, key: str, path: str, value: Any) -> list[Problem]:
    """Set the ``key`` of a ``place``, the last one of a ``path``; as ``put``."""
    item = ITEM.fullmatch(key)
    if item and isinstance(place, dict) and isinstance(place.get(item[1]), list):
        return _put_item(place[item[1]], int(item[2]) - 1, path, value)
    if not isinstance(place, dict):
        reason = "is a value, not a section"
        if place is None:
            reason = "does not exist"
        return [Problem(path, value, f"{path.removesuffix(f'.{key}')} {reason}")]
    if value is None and key not in place:
        return [Problem(path, None, "is not in the case, so that it cannot be removed")]

    if value is None:
        del place[key]
    else:
        place[key] = value
    return []


def value_at(table: dict[str, Any], path: str) -> Any:
    """Return the value that ``table`` has at ``path``, as ``put`` takes it; None if it has none."""
    place: Any = table
    rest = path
    while rest:
        if not isinstance(place, dict):
            return None
        key, rest = _divided(place, rest)
        place = _below(place, key)
    return place


def _divided(place: Any, path: str) -> tuple[str, str]:
    """Return the first key of a ``path`` into ``place``, and the rest of it; a key of a table may have dots itself."""
    dotted: list[str] = []
    if isinstance(place, dict):
        dotted = [key for key in place if "." in key and f"{path}.".startswith(f"{key}.")]
    # The longest: of the keys "a" and "a.b" in one table, the path "a.b.c" begins with the second.
    key = max(dotted, key=len, default=path.partition(".")[0])
    return key, path[len(key) + 1 :]


def _below(place: Any, key: str, put_missing: bool = False) -> Any:
    """Return the value of ``place`` at ``key``, which may name an entry of a list as in "masses[2]".

    Without a value it is None, or an empty table that is put there (``put_missing``). If ``place`` is no table, it is
    ``place`` itself: ``put`` then reports a value where a section should be.
    """
    if not isinstance(place, dict):
        return place
    item = ITEM.fullmatch(key)
    if item and isinstance(place.get(item[1]), list):
        entries = place[item[1]]
        number = int(item[2])
        if number > len(entries):
            return None
        return entries[number - 1]
    if put_missing:
        return place.setdefault(key, {})
    return place.get(key)


def _put_item(entries: list[Any], index: int, path: str, value: Any) -> list[Problem]:
    """Set the entry ``index`` (from 0) of a list; returns the problem if there is none."""
    if index >= len(entries) or value is None:
        count = f"{len(entries)} entr{'y' if len(entries) == 1 else 'ies'}"
        return [Problem(path, value, f"the list has {count}; to add or remove one, set the whole list")]
    entries[index] = value
    return []


def read_section(kind: type[AnySection], table: Any, name: str) -> tuple[AnySection, list[Problem]]:
    """Return the section ``name`` and its problems; with problems, the section holds the valid keys and defaults.

    All keys of the ``kind`` have defaults: a required key belongs to a table within a section.
    """
    if not isinstance(table, dict):
        return kind(), [Problem(name, table, f"must be a section [{name}]")]

    problems: dict[str, Problem] = {}
    # Numbers that are out of range may be of the right type; they are left out in the second reading too.
    invalid = {key for key, value in table.items() if any(_out_of_range(value, ""))}
    try:
        section = kind(**table)
    except ValidationError as error:
        for item in error.errors(include_url=False):
            problem = _problem_of(kind, name, item)
            problems.setdefault(problem.key, problem)
            # A problem of the section as a whole leaves none of its keys.
            invalid.update(item["loc"][:1] or table)

    # The type of a value comes first: of a value that is not of its key's type the range says nothing.
    mistyped = tuple(problems)
    problems |= {p.key: p for p in _out_of_range(table, name) if not is_within(p.key, mistyped)}
    if problems:
        # Read again without the invalid keys: the valid ones can still be checked against other sections.
        section, _ = read_section(kind, {k: v for k, v in table.items() if k not in invalid}, name)
    return section, list(problems.values())


def unknown_key(path: str, value: Any, valid: Iterable[str]) -> Problem:
    """Return the problem of a key that is not one of ``valid``, with the nearest one that is."""
    parents, dot, key = path.rpartition(".")
    near = nearest(key, valid)
    entry = re.fullmatch(r"(.+)\[\d+\]", key)
    remedy = f"valid keys: {', '.join(sorted(valid))}"
    if entry and entry[1] in valid:
        # "masses[0]", or an entry of what is not given as a list.
        return Problem(path, value, f"there is no such entry; entries count from 1, or set {parents}{dot}{entry[1]}")
    if near:
        remedy = f"did you mean {parents}{dot}{near}?"
    return Problem(path, value, f"unknown key; {remedy}")


def _out_of_range(value: Any, path: str) -> Iterator[Problem]:
    """Yield numbers anywhere in ``value`` that are so large or small that products of a few of them overflow."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _out_of_range(item, f"{path}.{key}")
    elif isinstance(value, list):
        for i, item in enumerate(value, 1):
            yield from _out_of_range(item, f"{path}[{i}]")
    # ``type`` rather than ``isinstance``: a boolean is an ``int`` for the latter.
    elif type(value) in (int, float) and (0 < abs(value) < 1 / LARGEST or LARGEST < abs(value) < math.inf):
        yield Problem(path, value, f"must have a magnitude between {1 / LARGEST:g} and {LARGEST:g}, in SI units")


def _problem_of(kind: type[Section], name: str, item: Any) -> Problem:
    """Return the problem behind one of pydantic's errors in section ``name``."""
    path = name
    for part in item["loc"]:
        # Items count from 1. The names of shapes are no part of a key's path.
        if isinstance(part, int):
            path += f"[{part + 1}]"
        elif not part.startswith(MARK):
            path += f".{part}"
    if item["type"] == "extra_forbidden":
        fields = _section_at(kind, item["loc"][:-1]).model_fields
        return unknown_key(path, item["input"], [field.alias or key for key, field in fields.items()])

    message = item["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    if item["type"] == "missing":
        # pydantic reports the whole section as the input of a missing key.
        remedy = "missing; this key is needed here"
        if item["loc"][-1] == "cell" and "place" in _section_at(kind, item["loc"][:-1]).model_fields:
            remedy = "missing; give the cell, or on a strip the place"
        return Problem(path, None, remedy)
    if item["type"] == "string_pattern_mismatch":
        # The key's description says what the pattern is for.
        fields = _section_at(kind, item["loc"][:-1]).model_fields
        message = f"is not valid: {fields[item['loc'][-1]].description}"
    value = item["input"]
    details = item.get("ctx", {})
    for limit in ("ge", "gt", "le", "lt"):
        if isinstance(details.get(limit), float):
            # pydantic writes small numbers with all their zeros.
            message = re.sub(r"[\d.]+$", f"{details[limit]:g}", message)
    if item["type"] == "list_type" and isinstance(value, dict):
        message += _list_remedy(kind, item["loc"], path)
    choices = details.get("expected")
    if isinstance(value, str) and choices:
        near = nearest(value, re.findall(r"'([^']+)'", choices))
        if near:
            message += f"; did you mean {near!r}?"
    if isinstance(value, str) and (unit := unit_at({name: kind}, path, {})):
        message += f', in {unit}, or a text with such a unit, as "1 {unit}"'
    return Problem(path, value, message)


def _list_remedy(kind: type[Section], place: Sequence[int | str], path: str) -> str:
    """Return what to write instead of a table at a ``place`` in the section ``kind`` where a list is needed."""
    keys = [part for part in place if isinstance(part, str) and not part.startswith(MARK)]
    section = _section_at(kind, place[: place.index(keys[-1])])
    if table_of(section, keys[-1]) is None:
        return ""
    if place[-1] == keys[-1]:
        return f" of tables; write [[{path}]]"
    # The key may also be a table, which is no entry of a list.
    return f"; give the table itself: {keys[-1]} = {{ ... }}, without [ ]"


def _section_at(kind: type[Section], path: Iterable[int | str]) -> type[Section]:
    """Return the class of the section to which a ``path`` within the section ``kind`` leads.

    The path has keys, numbers of items and, behind a key that may have several sections, the name of one of these.
    """
    choices: list[type[Section]] = []
    for key in path:
        fields = {field.alias or name: field.annotation for name, field in kind.model_fields.items()}
        if key in fields:
            choices = [*sections_in(fields[str(key)])] or choices
            kind = choices[0]
        # A class name in the path says which of the sections that the key before it may have was tried.
        for choice in choices:
            if f"{MARK}{choice.__name__}" == key:
                kind = choice
                break
    return kind


def sections_in(annotation: Any) -> Iterator[type[Section]]:
    """Yield the classes of sections in a type, those in a union, list or dictionary among them."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for argument in get_args(annotation):
        yield from sections_in(argument)
