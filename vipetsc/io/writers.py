"""A run's dataset with its fields (t, cell, dof), which are too large to be held whole, put together from chunks.

The writers are context managers that differ in open and close only: each gives a mapping from the names of the fields
to what takes values by ``fields[name][samples, cells] = values``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import xarray as xr

from vipetsc.io.netcdf import add_variable, put_dataset

FIELD_UNITS = {"displacement": "m", "velocity": "m/s"}


def describe_fields(data: xr.Dataset, names: tuple[str, ...]) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
    """Dimensions in ``data`` and attributes of each field."""
    time = "field_time" if "field_time" in data else "time"
    return {
        name: ((time, "cell", "dof"), {"units": FIELD_UNITS[name], "long_name": f"{name} of each mass"})
        for name in names
    }


@contextmanager
def fields_in_file(
    path: Path, data: xr.Dataset, names: tuple[str, ...], comm: MPI.Comm | None = None
) -> Iterator[Mapping[str, Any]]:
    """The fields of a new file ``path``: of one rank's, or of one that all ranks of ``comm`` share."""
    driver = {"driver": "mpio", "comm": comm} if comm is not None and comm.size > 1 else {}
    with h5py.File(path, "w", **driver) as file:
        put_dataset(file, data, write=comm is None or comm.rank == 0)
        for name, (dims, attributes) in describe_fields(data, names).items():
            add_variable(file, name, dims, [data.sizes[dim] for dim in dims], float, attributes)
        yield file


@contextmanager
def fields_in_memory(data: xr.Dataset, names: tuple[str, ...]) -> Iterator[Mapping[str, Any]]:
    """The fields as arrays, which become variables of ``data``."""
    described = describe_fields(data, names)
    arrays = {name: np.empty([data.sizes[dim] for dim in dims]) for name, (dims, _) in described.items()}
    yield arrays
    for name, (dims, attributes) in described.items():
        data[name] = dims, arrays[name], attributes
