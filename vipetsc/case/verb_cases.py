"""Cases of all verbs that read one case file."""

from collections.abc import Iterable
from pathlib import Path

from vipetsc.case.case import Case
from vipetsc.case.case_file import CaseFile
from vipetsc.case.design import DesignCase
from vipetsc.case.disorder import DisorderTable
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.law import LawCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import NnmCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.predict import PredictCase
from vipetsc.case.reading import Table, read_section, read_toml, with_overrides
from vipetsc.case.section import CaseError, Problem, Section
from vipetsc.case.sweep import Sweep

VERB_CASES: tuple[type[CaseFile], ...]
VERB_CASES = (Case, Sweep, NnmCase, DesignCase, LawCase, OptimiseCase, PredictCase, NfrcCase, IdentifyCase)
"""The case of every verb that reads one of its own, ``run`` first; sections, schema and manual follow this order."""

OF_SECTION = {kind.section: kind for kind in VERB_CASES if kind.section}
SECTIONS: dict[str, type[Section]] = {name: table for kind in VERB_CASES for name, table in kind.sections().items()}
"""Sections that a case file may have. A case reads those that it declares and ignores the others."""

# Sections by which a file is one of a run, or of verbs that consist of runs. Normal modes read the other sections too.
SECTIONS_OF_RUNS = {"disorder", "drive", "initial", "time", "output", "sweep", "optimise", "identify"}


def load_every(path: str | Path | None = None, overrides: Iterable[str] = ()) -> list[CaseFile]:
    """Return the cases of all verbs for which a file has sections, ``run`` first; the built-in case without a file.

    A file with the section of another verb is read as a run only if it has a section of runs. A sweep may give values
    that the run lacks: then its first valid member takes the place of the run. Raises CaseError with the problems of
    all verbs.
    """
    table, source = _table(path)
    overrides = list(overrides)
    cases: list[CaseFile] = []
    problems: dict[str, Problem] = {}
    for kind in _kinds(with_overrides(table, overrides)[0]):
        try:
            case = kind.from_table(table, overrides, source)
            if isinstance(case, Sweep):
                # A member takes the place of a run that is invalid without the values of the sweep.
                possible = [member.case for member in case.tried() if member.case]
                cases = cases or [*possible[:1]]
                problems = {}
            cases.append(case)
        except CaseError as error:
            problems |= {str(problem): problem for problem in error.problems}
    if problems:
        raise CaseError(problems.values(), source)
    return cases


def _kinds(table: Table) -> list[type[CaseFile]]:
    """Return the cases of the verbs that read a ``table``."""
    kinds: list[type[CaseFile]] = [kind for section, kind in OF_SECTION.items() if section in table]
    if not kinds or SECTIONS_OF_RUNS & table.keys():
        kinds.insert(0, Case)
    return kinds


def verbs_of(path: str | Path) -> list[str]:
    """Return the verbs of which a case file has the section, or ``run`` if there is none; raises CaseError."""
    table, _ = _table(path)
    return [kind.verb for section, kind in OF_SECTION.items() if section in table] or [Case.verb]


def disorder_of(
    path: str | Path | None, overrides: Iterable[str], cases: Iterable[CaseFile] = ()
) -> tuple[DisorderTable, Case, Case] | None:
    """Return scatter in a valid case file, the case without and with it; for a sweep, those of its first valid member.

    The sweep is taken from the ``cases`` that were read from the file, if it is among them, so that its members are
    resolved once.
    """
    table, _ = with_overrides(_table(path)[0], overrides)
    if "sweep" in table:
        plan = next((case for case in cases if isinstance(case, Sweep)), None) or Sweep.from_table(table)
        first = next(member for member in plan.tried() if member.case)
        table, _ = plan.member_table(first.index)
    if "disorder" not in table:
        return None

    # The case is valid, and so is the section.
    disorder, _ = read_section(DisorderTable, table["disorder"], "disorder")
    nominal = {key: section for key, section in table.items() if key != "disorder"}
    return disorder, Case.from_table(nominal), Case.from_table(table)


def _table(path: str | Path | None) -> tuple[Table, str]:
    """Return the table of a case file and what it is called; the built-in one without a file."""
    if path is None:
        return Case.builtin_table, "built-in case"
    return read_toml(path), str(path)
