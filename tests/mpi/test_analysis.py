"""Several ranks measure one run: the measures have the bits of one rank, and an error is raised on all ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest
import xarray as xr

from tests.conftest import small_case
from vipetsc.dynamics import simulate
from vipetsc.parallel import on_root
from vipetsc.studies import analysis
from vipetsc.studies.analysis import analyse

COMM = MPI.COMM_WORLD


@pytest.mark.parallel([1, 2, 3])
def test_ranks_take_different_measures_of_one_run(monkeypatch):
    """Each measure is computed on one rank; all ranks get all measures, with the order and attributes of one rank.

    An error in a measure is raised on all ranks.
    """

    def measured() -> tuple[xr.Dataset, xr.Dataset]:
        run = simulate(small_case(time={"end": 0.02}), comm=MPI.COMM_SELF).dataset
        return run, analyse(run)

    run, alone = on_root(COMM, measured)

    taken = []
    bands = analysis.band_energies
    monkeypatch.setattr(analysis, "band_energies", lambda *arguments: taken.append(1) or bands(*arguments))
    together = analyse(run, comm=COMM)
    assert together.identical(alone)
    assert list(together.variables) == list(alone.variables)
    assert COMM.allreduce(len(taken)) == 1

    def fail(*arguments):
        raise ValueError("no bands")

    monkeypatch.setattr(analysis, "band_energies", fail)
    with pytest.raises(ValueError, match="no bands"):
        analyse(run, comm=COMM)
