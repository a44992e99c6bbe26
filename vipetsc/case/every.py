"""One case file as every verb reads it."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from vipetsc.case.case import Case
from vipetsc.case.design import DesignCase
from vipetsc.case.nnm import NnmCase
from vipetsc.case.reading import CaseError, CaseFile, Problem, Table, read_toml, with_overrides
from vipetsc.case.sweep import Sweep

OF_SECTION: dict[str, type[CaseFile]] = {"sweep": Sweep, "nnm": NnmCase, "design": DesignCase}
OF_A_RUN = {"drive", "time", "output"}


def load_every(path: str | Path | None = None, overrides: Iterable[str] = ()) -> list[CaseFile]:
    """The cases that the verbs of the file's sections read from it, ``run`` first; the built-in one without a file.

    A file with ``[nnm]`` or ``[design]`` and no section of a run is not read as one. A sweep may give what a run
    lacks: then its first possible member stands for the run. Raises CaseError with the problems of all verbs.
    """
    table: Table = read_toml(path) if path else Case.builtin_table
    overrides, source = list(overrides), str(path) if path else "built-in case"
    changed, _ = with_overrides(table, overrides)
    kinds: list[type[CaseFile]] = [kind for section, kind in OF_SECTION.items() if section in changed]
    if not kinds or "sweep" in changed or OF_A_RUN & changed.keys():
        kinds.insert(0, Case)
    cases: dict[type[CaseFile], Any] = {}
    problems: dict[str, Problem] = {}
    for kind in kinds:
        try:
            cases[kind] = kind.from_table(table, overrides, source)
            if isinstance(cases[kind], Sweep):
                members = cases[kind].members()
                if Case not in cases:
                    cases = {Case: next(member.case for member in members if member.case)} | cases
                    problems = {}
        except CaseError as error:
            problems |= {str(problem): problem for problem in error.problems}
    if problems:
        raise CaseError(problems.values(), source)
    return list(cases.values())
