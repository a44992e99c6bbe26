"""A run that is kept in memory: for studies that measure it and write only what they need."""

from __future__ import annotations

import itertools
from pathlib import Path

import h5py
import xarray as xr

from vipetsc.case import Case
from vipetsc.io import store
from vipetsc.io.netcdf import put_dataset, write_netcdf
from vipetsc.io.run_file import RunFile

_NUMBERS = itertools.count()


class RunMemory(store.RunMemory):
    """A run in memory, as a file for those who read it with h5py."""

    def run(self, case: Case) -> RunFile:
        """The finished run as a file in memory (rank 0 only), with the fields that ``case`` names."""
        # HDF5 tells open files apart by their names, in memory too.
        file = h5py.File(f"memory-{next(_NUMBERS)}/run.h5", "w", driver="core", backing_store=False)
        put_dataset(file, self._with_fields(case))
        return RunFile(file)

    def save(self, path: Path, case: Case) -> None:
        """Write the finished run to ``path`` (rank 0 only), with the fields that ``case`` names."""
        write_netcdf(path, self._with_fields(case))

    def _with_fields(self, case: Case) -> xr.Dataset:
        assert self.dataset is not None
        dropped = [name for name in ("displacement", "velocity") if name not in case.output.fields]
        return self.dataset.drop_vars(dropped, errors="ignore").assign_attrs(case=case.to_toml())
