"""The base class of every verb's case: its sections are read strictly, and every problem is reported at once.

A subclass declares the sections that its verb reads; ``reading`` turns tables into sections.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache, lru_cache
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import tomli_w

from vipetsc.case.cell_matrices import with_matrices
from vipetsc.case.parts import PluginsTable, changed_modules, missing_modules, module_names, warn_once, with_sources
from vipetsc.case.reading import (
    Table,
    parsed,
    plain_table,
    read_section,
    read_toml,
    sections_in,
    unknown_key,
    with_overrides,
    wrong_keys,
)
from vipetsc.case.section import CaseError, Problem, Section, described, is_within
from vipetsc.case.strip import with_strip
from vipetsc.plugins import only
from vipetsc.register import PartError

if TYPE_CHECKING:
    import xarray as xr

FOLDER = re.compile(r"[^\s./\\-][^/\\]*")  # a name of a folder that is neither hidden nor taken for an option
LONGEST_NAME = 200  # bytes; file systems take 255, and names of temporary files are longer
Valid = Callable[..., bool]  # whether neither any of the keys given nor a key inside it is invalid


class CaseFile(Section):
    """Case of a verb as its file gives it: a ``name`` and the sections that a subclass declares as its fields.

    A subclass names its ``verb`` and the ``section`` that only this verb reads ("" for ``run``), and gives in
    ``refuses`` the reason for every feature of a lattice run that it does not accept (``vipetsc.case.features``);
    ``waveforms`` are the drives that it accepts if it refuses others; ``has_members`` is True if its table is only read
    as that of each member. Its hooks: ``check`` finds problems between valid
    keys; ``read`` may fill in the table before its sections are read, and resolve them afterwards. ``builtin_table`` is
    the case without a file, if there is one.
    """

    name: str = described("name of the output folder runs/NAME; default: the name of the file")
    plugins: PluginsTable | None = None

    verb: ClassVar[str] = ""
    section: ClassVar[str] = ""
    refuses: ClassVar[Mapping[str, str]] = {}
    waveforms: ClassVar[tuple[str, ...]] = ()
    builtin_table: ClassVar[Table] = {}
    has_members: ClassVar[bool] = False

    def __init__(self, *unnamed: Any, **sections: Any) -> None:
        """Read and resolve the case of these ``sections``: tables by keyword, with a ``name`` or without.

        ``Case(lattice={"cells": 60}, drive={"amplitude": 8.0})`` is the case of a file with these sections. Values are
        as in a file; arrays, tuples and sections of another case are taken too, and None is a key that is not given.
        Raises CaseError with all problems.
        """
        kind = type(self).__name__
        if unnamed:
            ways = f"{kind}.load takes the name of a file, {kind}.from_table a table"
            raise TypeError(f"{kind} takes its sections by name, as in {kind}(lattice={{...}}); {ways}")
        super().__init__(**self.fields_of(plain_table(sections)))

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        """Name the sections in the signature, which completion and ``help`` show."""
        names = "name", *cls.keywords()
        cls.__signature__ = Signature([Parameter(name, Parameter.KEYWORD_ONLY, default=None) for name in names])

    @classmethod
    def keywords(cls) -> Iterable[str]:
        """Return the names of the sections that a case of this verb is built of."""
        return cls.sections()

    @classmethod
    @cache  # reading a case asks for the sections of all verbs
    def sections(cls) -> dict[str, type[Section]]:
        """Return the class of each section that the verb reads, by the section's name."""
        classes: dict[str, type[Section]] = {}
        for key, field in cls.model_fields.items():
            # Studies have the section of their own in the field ``options``.
            name = key
            if key == "options":
                name = cls.section
            for kind in sections_in(field.annotation):
                if not issubclass(kind, CaseFile):
                    classes[name] = kind
        return classes

    @classmethod
    def load(cls, path: str | Path | None = None, overrides: Iterable[str] = ()) -> Self:
        """Return the case in the file ``path``, or the built-in one, with ``a.b=value`` overrides; raises CaseError."""
        if not isinstance(path, str | Path | None):
            raise TypeError(f"{cls.__name__}.load takes the name of a case file, not {path!r}")
        # Not for an empty name, which an unset variable of a shell gives: a built-in case is not what is meant.
        if path is None:
            return cls.from_table(cls.builtin_table, overrides, "built-in case")
        return cls.from_table(read_toml(path), overrides, str(path))

    @classmethod
    def from_toml(cls, text: str) -> Self:
        """Return the case written in ``text``; raises CaseError."""
        if not isinstance(text, str):
            raise TypeError(f"{cls.__name__}.from_toml takes a text, not {text!r}")
        return cls.from_table(parsed(text, "case"))

    @classmethod
    def of(cls, run: "xr.Dataset") -> Self:
        """Return the resolved case that a file of results carries in its attribute ``case``."""
        text = getattr(run, "attrs", {}).get("case")
        if not isinstance(text, str):
            raise TypeError(f"{cls.__name__}.of takes a dataset of results, with its case in attrs['case']")
        case = _kept_case(cls, text)
        assert isinstance(case, cls)
        # A kept case was read before, and the modules that it names may have changed since.
        problems = changed_modules(case.plugins) if case.plugins else []
        if problems:
            raise CaseError(problems, case.name)
        return case

    @classmethod
    def expect(cls, case: Any, function: str) -> None:
        """Raise TypeError if a ``function`` that takes a case of this verb is called with another ``case``."""
        if not isinstance(case, cls):
            given = f"not {type(case).__name__}; {cls.__name__}.load reads a file"
            raise TypeError(f"{function} takes a case of the class {cls.__name__}, {given}")

    @classmethod
    def from_table(cls, table: Table, overrides: Iterable[str] = (), source: str = "case") -> Self:
        """Return the resolved case of a parsed table; raises CaseError with all problems."""
        return cls.resolved(cls.fields_of(table, overrides, source))

    @classmethod
    def resolved(cls, fields: Mapping[str, Any]) -> Self:
        """Return the case with these ``fields``, which are resolved already."""
        case = cls.__new__(cls)
        Section.__init__(case, **fields)
        return case

    @classmethod
    def fields_of(cls, table: Table, overrides: Iterable[str] = (), source: str = "case") -> dict[str, Any]:
        """Return the resolved fields of a parsed table, its name among them; raises CaseError."""
        if not isinstance(table, dict):
            raise TypeError(f"{cls.__name__}.from_table takes a table of sections by name, a dict, not {table!r}")
        if isinstance(overrides, str) or not isinstance(overrides, Iterable):
            raise TypeError(f"overrides are a list of texts, as ['lattice.cells=60'], not {overrides!r}")
        problems = list(wrong_keys(table))
        if problems:
            raise CaseError(problems, source)

        if overrides:
            table, problems = with_overrides(table, overrides)
            problems += _filled_in(overrides)
        # One file may have sections of several verbs. A dictionary keeps their order, which a message shows.
        valid = {"name": None, **dict.fromkeys(_declared_sections(CaseFile))}
        problems += [unknown_key(key, table[key], valid) for key in table if key not in valid]
        name = table.get("name", "case")
        problems += _check_name(name)

        table, unread = with_matrices(table)
        # Places are those of a member's strip, not of the table that its sweep begins with.
        if not unread and not cls.has_members:
            table, unread = with_strip(table)
        # Without its cell a case has no other sense: only its matrices or its strip are reported.
        if unread:
            raise CaseError(problems + unread, source)
        # Results can be read without modules that their cases do not need, such as those of measures.
        section = table.get("plugins")
        is_resolved = isinstance(section, dict) and "sources" in section
        table, missing = with_sources(table)
        plugins: PluginsTable | None = None
        mistyped: list[Problem] = []
        if "plugins" in table:
            plugins, mistyped = read_section(PluginsTable, table["plugins"], "plugins")
        # Without the modules, names of parts in the case would be invalid too: only the modules are reported.
        if mistyped or (missing and not is_resolved):
            raise CaseError(problems + missing + mistyped, source)

        try:
            # Other cases in this process may have imported further modules, whose parts this case must not find.
            with only(module_names(table)):
                fields, wrong = cls.read(table)
        except PartError as error:
            raise CaseError([*problems, Problem("plugins.modules", module_names(table), str(error))], source) from error
        if problems + wrong:
            raise CaseError(missing + problems + wrong, source)
        for problem in missing:
            # Without the folder: two files of moved results may name the module by its old and its new path.
            file = Path(str(problem.value)).name
            warn_once(f"{file}: {problem.remedy}; its parts are left out".replace(str(problem.value), file))
        return {"name": name, "plugins": plugins, **fields}

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the fields other than ``name``, and all problems with the sections they come from."""
        fields: dict[str, Any] = {}
        problems: list[Problem] = []
        for key, field in cls.model_fields.items():
            if key not in ("name", "plugins") and (key in table or field.is_required()):
                kind = next(sections_in(field.annotation))
                fields[key], wrong = read_section(kind, table.get(key, {}), key)
                problems += wrong

        # An invalid key holds its default, about which a problem between keys would say nothing: checks ask ``valid``.
        invalid = {problem.key for problem in problems}

        def valid(*keys: str) -> bool:
            return not any(is_within(i, keys) for i in invalid)

        return fields, problems + [p for p in cls.check(fields, valid) if valid(p.key)]

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> Iterable[Problem]:
        """Return problems between keys; keys that are not ``valid`` are reported already, and hold their defaults."""
        return ()

    def import_plugins(self) -> None:
        """Import the modules of the case, which another rank may have read; raises CaseError."""
        if self.plugins is None:
            return
        problems = missing_modules(self.plugins)
        if problems:
            raise CaseError(problems, self.name)

    def warnings(self) -> list[str]:
        """Return warnings of settings that are allowed but probably unintended."""
        return []

    def runs(self) -> list["CaseFile"]:
        """Return the cases of runs that the verb simulates, as far as they are fixed before it begins."""
        return []

    @property
    def petsc_options(self) -> dict[str, str]:
        """The PETSc options of the case by name, without the leading dash."""
        return {}

    @property
    def wants_pictures(self) -> bool:
        """Whether the results are drawn."""
        return True

    def __copy__(self) -> Self:
        # A copy may get other fields (``model_copy``), and what cached properties hold follows from the old ones.
        copied = super().__copy__()
        for name in copied.__dict__.keys() - type(self).model_fields.keys():
            del copied.__dict__[name]
        return copied

    def __getstate__(self) -> dict[Any, Any]:
        # Cases are sent to other ranks without the values of cached properties, which are larger than the case.
        fields = {name: value for name, value in self.__dict__.items() if name in type(self).model_fields}
        return super().__getstate__() | {"__dict__": fields}

    def to_toml(self) -> str:
        """Return the resolved case as TOML; reading it back gives the same case."""
        return tomli_w.dumps(self.model_dump(by_alias=True, exclude_none=True))


# Each measure and picture of a run asks for its case.
@lru_cache(maxsize=4)
def _kept_case(kind: type[CaseFile], text: str) -> CaseFile:
    """Return the resolved case of a ``kind`` in a ``text`` of TOML."""
    return kind.from_toml(text)


def _declared_sections(kind: type[CaseFile]) -> Iterator[str]:
    """Yield the names of the sections that some verb's case reads, ``kind`` and its subclasses among them."""
    yield from kind.sections()
    # ``__subclasses__`` lists direct subclasses only; the case of ``predict`` derives from that of ``law``.
    for subclass in kind.__subclasses__():
        yield from _declared_sections(subclass)


def _filled_in(overrides: Iterable[str]) -> Iterator[Problem]:
    """Yield problems with ``overrides`` of what a resolved case records about its modules."""
    for override in overrides:
        key = override.partition("=")[0].strip()
        if f"{key}.".startswith("plugins.sources."):
            yield Problem(f"--set {key}", None, "is filled in from the modules; remove it")


def _check_name(name: Any) -> Iterator[Problem]:
    """Yield problems with the name of a case, which names its output folder."""
    if not isinstance(name, str) or not name:
        yield Problem("name", name, "must be a non-empty string")
    elif not (name.isprintable() and FOLDER.fullmatch(name) and len(name.encode()) <= LONGEST_NAME):
        remedy = (
            f"names the output folder: use at most {LONGEST_NAME} bytes, no / or \\, and no dot or dash at the start"
        )
        yield Problem("name", name, remedy)
