"""A run that is kept in memory: for studies that measure it and write only what they need."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.case import Case
from vipetsc.io.atomic import atomic_write
from vipetsc.io.run_file import RunFile
from vipetsc.io.store import RunFolder

_NUMBERS = itertools.count()


class RunMemory(RunFolder):
    """Takes the place of a run's folder for ``simulate``; nothing is written until ``save``.

    Without checkpoints: a run that is stopped is lost. Fields are gathered on rank 0 of ``comm``, so the
    case's writer must be ``gather``.
    """

    def __init__(self, comm: MPI.Comm = MPI.COMM_SELF) -> None:
        super().__init__(Path("memory"), comm)
        self._parts: list[dict[str, np.ndarray] | None] = []
        self._about: dict[str, Any] = {}
        self._cells = np.zeros(0, np.int64)

    def prepare(self, case: Case, force: bool, resume: bool) -> None:
        """Begin anew; raises ValueError if the case asks for parallel writing or to be resumed."""
        if resume or case.output.writer == "parallel":
            raise ValueError("a run in memory is gathered on one rank and cannot be resumed")
        self._parts.clear()

    def write_part(self, number: int, part: Mapping[str, np.ndarray] | None) -> None:
        """Keep a part."""
        self._parts.append(part)

    def read_part(self, number: int, rank: int, wanted: Collection[str]) -> Mapping[str, np.ndarray]:
        """Part ``number``; all of it is here, whatever the rank."""
        return self._parts[number]

    def write_state(self, number: int, state: dict[str, np.ndarray]) -> None:
        """No checkpoints."""

    def assemble(self, case: Case, cells: np.ndarray, parts: int, parallel: bool, about: dict[str, Any]) -> None:
        """Remember what ``run`` and ``save`` need besides the parts."""
        self._cells, self._about = cells, about

    def finish(self, summary: dict[str, Any]) -> None:
        """Nothing to tidy up."""

    def run(self, case: Case) -> RunFile:
        """The finished run as a file in memory (rank 0 only), with the fields that ``case`` names."""
        # HDF5 tells open files apart by their names, in memory too.
        file = h5py.File(f"memory-{next(_NUMBERS)}/run.h5", "w", driver="core", backing_store=False)
        self._write(file, case)
        return RunFile(file)

    def save(self, path: Path, case: Case) -> None:
        """Write the finished run to ``path`` (rank 0 only), with the fields that ``case`` names."""
        with atomic_write(path) as aside, h5py.File(aside, "w") as file:
            self._write(file, case)

    def _write(self, file: h5py.File, case: Case) -> None:
        total = len(self._cells)
        self._fill(file, case, self._cells, 0, total, len(self._parts), self._about, MPI.COMM_SELF)
