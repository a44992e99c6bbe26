"""The error of a case that cannot be used, with all reasons."""

from collections.abc import Iterable

from vipetsc.case.section import Problem
from vipetsc.wording import counted


class CaseError(ValueError):
    """An invalid case; ``problems`` contains all reasons."""

    def __init__(self, problems: Iterable[Problem], source: str = "case") -> None:
        self.problems = list(problems)
        self.source = source
        super().__init__(self.problems, source)  # the arguments of unpickling on other ranks

    def __str__(self) -> str:
        return "\n  ".join([f"{self.source}: {counted(len(self.problems), 'problem')}", *map(str, self.problems)])
