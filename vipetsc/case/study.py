"""Cases of studies: the sections of a run, and one section of the study's own."""

from collections.abc import Iterable

from vipetsc.case.case import Case
from vipetsc.case.case_file import CaseFile
from vipetsc.case.reading import Table
from vipetsc.case.section import Problem


class StudyCase(CaseFile):
    """The case of a study of many runs: its ``table`` is that of a run, without the study's ``section``."""

    table: Table

    @classmethod
    def keywords(cls) -> Iterable[str]:
        """Return the sections of a run, and that of the study."""
        # This class itself has no section.
        if not cls.section:
            return [*Case.sections()]
        return [*Case.sections(), cls.section]

    @classmethod
    def divide(cls, table: Table, remedy: str) -> tuple[Table, Table, list[Problem]]:
        """Return table of a run and the study's section, out of ``table``; the problem of a section that is missing.

        The problem's text ends with the ``remedy``.
        """
        of_run = dict(table)
        section = of_run.pop(cls.section, None)
        if not isinstance(section, dict):
            return of_run, {}, [Problem(cls.section, section, f"missing; {remedy}")]
        return of_run, section, []
