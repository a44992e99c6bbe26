"""What ``run.h5`` holds; the chunks of a run put together as one dataset in the layout of ``io.netcdf``, or in a file.

Every share of a chunk says what it is of: fields (sample, dof, cell) are of the ranges ``columns`` of the recorded
cells, losses (sample, site) of the ranges ``sites``; ``impacts`` are episodes. Rank 0's has ``SAMPLED`` besides.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from mpi4py import MPI

import h5py
import numpy as np
import xarray as xr

from vipetsc.io.atomic import Arrays
from vipetsc.io.netcdf import tabulated

# Name in the file: dimensions, units, text. What a chunk holds besides fields, and what is known from the beginning.
SAMPLED = {
    "time": ("time", "s", "time"),
    "field_time": ("field_time", "s", "time of the recorded fields"),
    "energy/kinetic": ("time", "J", "kinetic energy"),
    "energy/spring": ("time", "J", "energy of the springs"),
    "energy/contact": ("time", "J", "elastic energy of the contacts"),
    "energy/work": ("time", "J", "work done by the drive"),
    "energy/dissipated": ("time", "J", "energy dissipated in contacts"),
}
DAMPED = "energy/dissipated_by_damping"
OF_DAMPED = {DAMPED: ("time", "J", "energy dissipated in dashpots")}
# Fields, losses and the log of contacts, of which ranks that write together hold their own alone.
LOSSES = "energy/dissipated_by_site"
LARGE = {
    "displacement": ("field_time cell dof", "m", "displacement of each mass"),
    "velocity": ("field_time cell dof", "m/s", "velocity of each mass"),
    "end/displacement": ("cell dof", "m", "displacement of each mass at the last sample"),
    "end/velocity": ("cell dof", "m/s", "velocity of each mass at the last sample"),
    LOSSES: ("time site", "J", "energy dissipated at each site"),
    "episode": ("episode", "1", "contact episode, by onset"),
    "impacts/site": ("episode", "1", "site, counted from 1"),
    "impacts/side": ("episode", "1", "side of the clearance: +1 or -1"),
    "impacts/onset": ("episode", "s", "time of onset"),
    "impacts/approach_velocity": ("episode", "m/s", "relative velocity at onset, w'_minus"),
    "impacts/separation": ("episode", "s", "time of separation; NaN if still in contact"),
    "impacts/indentation": ("episode", "m", "largest indentation"),
    "impacts/force": ("episode", "N", "largest contact force"),
    "impacts/loss": ("episode", "J", "energy dissipated in the episode"),
}
GIVEN = {
    "cell": ("cell", "1", "cell, counted from 1"),
    "dof": ("dof", "1", "mass within the cell, from 1"),
    "site": ("site", "1", "contact site, from 1"),
    "spring": ("spring", "1", "spring of the cell, from 1"),
    "lattice/masses": ("cell dof", "kg", "mass"),
    "lattice/grounding": ("cell dof", "N s/m", "dashpot to ground"),
    "lattice/stiffness": ("cell spring", "N/m", "stiffness of the spring"),
    "lattice/damping": ("cell spring", "N s/m", "dashpot beside the spring"),
    "sites/cell": ("site", "1", "cell of the site"),
    "sites/clearance": ("site", "m", "clearance of the site"),
    "sites/clearance_minus": ("site", "m", "clearance on the side of negative relative displacement, if it differs"),
}


@dataclass(frozen=True)
class Recording:
    """What the chunks of a run hold.

    ``given``: the arrays of ``GIVEN``; ``fields``: names of those that are recorded; ``together``: whether all ranks
    write into one file that they share, instead of rank 0 alone; ``rows``: samples in a field of the whole run.
    ``sampled``: what rank 0 has of every sample, of ``SAMPLED`` and ``OF_DAMPED``.
    """

    given: Arrays
    fields: tuple[str, ...]
    together: bool
    rows: int
    sampled: Collection[str] = tuple(SAMPLED)


class Chunks(Protocol):
    """The ``count`` chunks of a run; chunk k has a share of each of ``ranks(k)``, from which ``read`` reads arrays."""

    comm: MPI.Comm
    case: str
    count: int
    recording: Recording

    def ranks(self, number: int) -> list[int]: ...  # noqa: D102
    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays: ...  # noqa: D102


def ranges(numbers: np.ndarray) -> np.ndarray:
    """Half-open ranges (range, 2) of consecutive ``numbers``."""
    breaks = np.diff(numbers, prepend=-2, append=-2) != 1
    return np.stack([numbers[breaks[:-1]], numbers[breaks[1:]] + 1], axis=1)


def joined(output: Chunks, names: Collection[str]) -> dict[str, np.ndarray]:
    """The arrays ``names`` of rank 0, those of all chunks one after the other."""
    chunks = [output.read(number, 0, names) for number in range(output.count)]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names}


def small_dataset(output: Chunks, attributes: Mapping[str, Any]) -> xr.Dataset:
    """What is known of a run from the beginning, and what rank 0 keeps of every sample."""
    arrays = {**joined(output, output.recording.sampled), **output.recording.given}
    if len(arrays["field_time"]) == len(arrays["time"]):
        del arrays["field_time"]
    return xr.Dataset(tabulated(SAMPLED | OF_DAMPED | GIVEN, arrays), attrs={"case": output.case, **attributes})


def described(name: str, data: xr.Dataset) -> tuple[list[str], dict[str, str]]:
    """Dimensions and attributes of a variable of ``LARGE`` beside ``data``, whose time may be that of the fields."""
    dims, units, text = LARGE[name]
    dims = dims if "field_time" in data else dims.replace("field_time", "time")
    return dims.split(), {"units": units, "long_name": text}


def coordinates(name: str) -> dict[str, str]:
    """What a file says besides, by the CF conventions: an episode's time is a coordinate of what is told of it."""
    return {"coordinates": "onset"} if name.startswith("impacts/") and name != "impacts/onset" else {}


def writers(output: Chunks) -> MPI.Comm:
    """The ranks that write together, or this one."""
    return output.comm if output.recording.together else MPI.COMM_SELF


def shares(output: Chunks, number: int, wanted: Collection[str]) -> Iterator[Arrays]:
    """Those of chunk ``number`` that this rank reads; ranks that write together share them out."""
    comm = writers(output)
    return (output.read(number, rank, wanted) for rank in output.ranks(number) if rank % comm.size == comm.rank)


def read_log(output: Chunks) -> np.ndarray:
    """The episodes that this rank reads, in no order."""
    return np.concatenate([share["impacts"] for k in range(output.count) for share in shares(output, k, ["impacts"])])


def log_columns(log: np.ndarray, first: int = 0) -> Arrays:
    """The variables of the episodes ``log``, in order, of which so many come before the ``first``."""
    names = log.dtype.names or ()
    return {"episode": np.arange(first, first + len(log)) + 1} | {f"impacts/{name}": log[name] for name in names}


def put_chunks(dataset: h5py.Dataset, output: Chunks, name: str) -> None:
    """Copy the losses or a field, ``name``, of all chunks to ``dataset``; ranks that write together share them."""
    first, (time, of) = 0, ("time", "sites") if name == LOSSES else ("field_time", "columns")
    for number in range(output.count):
        rows = output.read(number, 0, [time])[time].size
        for share in shares(output, number, [name, of]):
            values, at = np.moveaxis(share[name], -1, 1), 0
            for start, stop in share[of].tolist():
                # h5py leaves out empty selections, on which writing together would hang.
                if rows and start < stop:
                    dataset[first : first + rows, start:stop] = values[:, at : at + stop - start]
                at += stop - start
        first += rows
