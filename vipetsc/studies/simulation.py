"""A simulation for scripts and notebooks: that of ``vipetsc.dynamics``, with a result that draws its own pictures."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from typing import ParamSpec

from matplotlib.figure import Figure

from vipetsc.dynamics import run
from vipetsc.dynamics.result import Result
from vipetsc.studies.pictures import plot

Arguments = ParamSpec("Arguments")


@dataclass(frozen=True)
class DrawnResult(Result):
    """Result of a run, and its pictures."""

    def plot(self, name: str) -> Figure:
        """Return the picture ``name`` of the run as a figure of matplotlib; see ``vipetsc.plot``."""
        return plot(self, name)


def _with_pictures(function: Callable[Arguments, Result]) -> Callable[Arguments, DrawnResult]:
    """Return ``function`` with a result that draws."""

    @wraps(function)
    def drawn(*args: Arguments.args, **keywords: Arguments.kwargs) -> DrawnResult:
        result = function(*args, **keywords)
        return DrawnResult(**{field.name: getattr(result, field.name) for field in fields(Result)})

    return drawn


simulate = _with_pictures(run.simulate)
