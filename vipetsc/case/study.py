"""Cases of studies: the sections of a run, and one section of the study's own."""

from collections.abc import Iterable

from vipetsc.case.case import Case
from vipetsc.case.case_file import CaseFile, Problem, Table


class StudyCase(CaseFile):
    """The case of a study of many runs: its ``table`` is that of a run, without the study's ``section``."""

    table: Table

    @classmethod
    def keywords(cls) -> Iterable[str]:
        """The sections of a run, and that of the study."""
        of_study = [cls.section] if cls.section else []  # this class has none
        return (*Case.sections(), *of_study)

    @classmethod
    def divide(cls, table: Table, remedy: str) -> tuple[Table, Table, list[Problem]]:
        """The table of a run and the study's section in ``table``; a problem with the ``remedy`` if it is missing."""
        of_run = dict(table)
        section = of_run.pop(cls.section, None)
        if not isinstance(section, dict):
            return of_run, {}, [Problem(cls.section, section, f"missing; {remedy}")]
        return of_run, section, []


def with_fastest_engine(table: Table) -> Table:
    """The ``table`` of a run with the fastest engine that it allows, unless it names one: many runs want that."""
    time = table.get("time", {})
    if not isinstance(time, dict):
        return table
    return table | {"time": {"engine": "auto"} | time}
