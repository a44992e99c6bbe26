"""Result of a run: how it ended, in words and in numbers, and the run itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vipetsc.case.html import html_table
from vipetsc.io.read import open_results

if TYPE_CHECKING:
    import xarray as xr

    from vipetsc.dynamics.plan import RunPlan

# Statistics that a notebook shows, with their words.
SHOWN = {
    "engine": "engine",
    "samples": "samples",
    "episodes": "impacts",
    "work": "work in J",
    "dissipated": "dissipated in J",
    "ledger_error": "error of the energy balance",
    "wall_seconds": "wall time in s",
}


@dataclass(frozen=True)
class Result:
    """Result of a run.

    ``complete``: the whole case was simulated; ``resumable``: it was stopped and can go on from its last
    checkpoint; neither: it failed, and ``run.h5`` holds the samples up to the last good one. ``sentence`` says
    it in words, ``statistics`` in numbers; ``warnings`` are sentences about results that are not what they seem. All
    are the same on all ranks, but for ``held``, the run of a simulation without a folder, which rank 0 has. A run in a
    folder has its ``plan``.
    """

    complete: bool
    resumable: bool
    sentence: str
    statistics: dict[str, Any]
    warnings: list[str]
    folder: Path | None
    held: "xr.Dataset | None" = field(default=None, repr=False, compare=False)
    plan: "RunPlan | None" = field(default=None, repr=False, compare=False)

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any], *, resumable: bool, folder: Path | None) -> "Result":
        """Return the result that the ``attributes`` of a run's file state."""
        return cls(
            complete=attributes["complete"],
            resumable=resumable,
            sentence=attributes["status"],
            statistics=attributes["statistics"],
            warnings=attributes.get("warnings", []),
            folder=folder,
        )

    @cached_property
    def dataset(self) -> "xr.Dataset | None":
        """The run: opened in its folder, or the one in memory, which only rank 0 has; None for one that was stopped.

        Raises OSError if the file is gone.
        """
        if self.folder is None or self.resumable:
            return self.held
        return open_results(self.folder / "run.h5")

    def _repr_html_(self) -> str:
        """Return the ending, warnings and some numbers, as a notebook shows them."""
        rows = [(text, self.statistics.get(key)) for key, text in SHOWN.items()]
        rows += [("run", self.folder or "in memory, as `dataset`")]
        rows += [("warning", warning) for warning in self.warnings]
        return html_table(self.sentence, rows)
