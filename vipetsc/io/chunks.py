"""The variables of ``run.h5``, and their assembly from the chunks of a run.

A chunk holds the samples between two checkpoints. Each rank stores a part of it, with its position: fields (sample,
dof, cell) belong to the ranges ``columns`` of the recorded cells, losses (sample, site) to the ranges ``sites``;
``impacts`` are episodes. The part of rank 0 also has ``SAMPLED``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.io.atomic import Arrays
from vipetsc.io.netcdf import tabulated

if TYPE_CHECKING:
    import xarray as xr

# Variables of the file by name: dimensions, units, text.
# Rank 0 has ``SAMPLED``, ``DAMPING`` and ``MOTION`` of every sample; ``GIVEN`` exists before the first one. ``LARGE``
# are the fields, losses and forces and the log of contacts: of ranks that write together each holds only its part.
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
DAMPING = {DAMPED: ("time", "J", "energy dissipated in dashpots")}
MOTION = {
    "points/displacement": ("time point", "m", "displacement of the point"),
    "points/velocity": ("time point", "m/s", "velocity of the point"),
    "points/acceleration": ("time point", "m/s2", "acceleration of the point, by the equation of motion"),
}
LOSSES = "energy/dissipated_by_site"
FORCES = "sites/force"
LARGE = {
    "displacement": ("field_time cell dof", "m", "displacement of each mass"),
    "velocity": ("field_time cell dof", "m/s", "velocity of each mass"),
    "end/displacement": ("cell dof", "m", "displacement of each mass at the last sample"),
    "end/velocity": ("cell dof", "m/s", "velocity of each mass at the last sample"),
    LOSSES: ("time site", "J", "energy dissipated at each site"),
    FORCES: ("time site", "N", "contact force on the host, its opposite on the resonator"),
    "episode": ("episode", "1", "contact episode, by onset"),
    "impacts/site": ("episode", "1", "site, counted from 1"),
    "impacts/side": ("episode", "1", "side of the clearance: +1 or -1"),
    "impacts/onset": ("episode", "s", "time of onset"),
    "impacts/approach_velocity": ("episode", "m/s", "relative velocity w'_minus at onset, with the sign of the side"),
    "impacts/separation": ("episode", "s", "time of separation; NaN if still in contact"),
    "impacts/indentation": ("episode", "m", "largest indentation"),
    "impacts/force": ("episode", "N", "largest contact force"),
    "impacts/loss": ("episode", "J", "energy dissipated in the episode"),
}
GIVEN = {
    "cell": ("cell", "1", "cell, counted from 1"),
    "dof": ("dof", "1", "mass within the cell, counted from 1"),
    "site": ("site", "1", "contact site, counted from 1"),
    "spring": ("spring", "1", "spring of the cell, counted from 1"),
    "lattice/masses": ("cell dof", "kg", "mass"),
    "lattice/grounding": ("cell dof", "N s/m", "dashpot to ground"),
    "lattice/stiffness": ("cell spring", "N/m", "stiffness of the spring"),
    "lattice/damping": ("cell spring", "N s/m", "dashpot parallel to the spring"),
    "lattice/quadratic": ("cell spring", "N/m^2", "coefficient of the spring's elongation squared in its force"),
    "lattice/cubic": ("cell spring", "N/m^3", "coefficient of the spring's elongation cubed in its force"),
    "sites/cell": ("site", "1", "cell of the site"),
    "sites/clearance": ("site", "m", "clearance of the site"),
    "sites/clearance_minus": ("site", "m", "clearance for negative relative displacement, if it differs"),
    "point": ("point", "1", "point, counted from 1"),
    "points/cell": ("point", "1", "cell of the point"),
    "points/mass": ("point", "1", "mass of the point, within its cell"),
}


@dataclass(frozen=True)
class Recording:
    """Description of the contents of the chunks of a run.

    ``given``: the arrays of ``GIVEN``; ``fields``: names of the recorded ones; ``together``: whether all ranks write
    into one common file, instead of rank 0 alone; ``rows``: samples in a field of the whole run. ``sampled``: names of
    the variables that rank 0 has of every sample, from ``SAMPLED``, ``DAMPING`` and ``MOTION``; ``of_sites``: names of
    those over (time, site).
    """

    given: Arrays
    fields: tuple[str, ...]
    together: bool
    rows: int
    sampled: Collection[str] = tuple(SAMPLED)
    of_sites: tuple[str, ...] = (LOSSES,)


class Chunks(Protocol):
    """The ``count`` chunks of a run; ``ranks(k)`` have stored parts of chunk k, from which ``read`` reads arrays."""

    comm: MPI.Comm
    case: str
    count: int
    recording: Recording

    def ranks(self, number: int) -> list[int]: ...  # noqa: D102
    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays: ...  # noqa: D102


def ranges(numbers: np.ndarray) -> np.ndarray:
    """Half-open ranges (range, 2) of consecutive ``numbers``."""
    # -2 is no cell's number, nor next to one: there is a break at both ends.
    breaks = np.diff(numbers, prepend=-2, append=-2) != 1
    return np.stack([numbers[breaks[:-1]], numbers[breaks[1:]] + 1], axis=1)


def joined(output: Chunks, names: Collection[str]) -> dict[str, np.ndarray]:
    """The arrays ``names`` (sample, ...) of rank 0, all chunks one after the other."""
    chunks = [output.read(number, 0, names) for number in range(output.count)]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names}


def small_dataset(output: Chunks, attributes: Mapping[str, Any]) -> xr.Dataset:
    """The dataset of ``GIVEN`` and of all that rank 0 has of every sample, with the root ``attributes`` of the run."""
    import xarray as xr

    arrays = {**joined(output, output.recording.sampled), **output.recording.given}
    if len(arrays["field_time"]) == len(arrays["time"]):
        del arrays["field_time"]  # fields are of every sample
    variables = tabulated(SAMPLED | DAMPING | MOTION | GIVEN, arrays)
    return xr.Dataset(variables, attrs={"case": output.case, **attributes})


class Description(NamedTuple):
    """Dimensions and attributes of a variable."""

    dims: list[str]
    attributes: dict[str, str]


def described(name: str, data: xr.Dataset) -> Description:
    """The description of a variable of ``LARGE`` in a file with ``data``, whose time may be that of the fields."""
    dims, units, text = LARGE[name]
    if "field_time" not in data:
        dims = dims.replace("field_time", "time")
    return Description(dims=dims.split(), attributes={"units": units, "long_name": text})


def coordinates(name: str) -> dict[str, str]:
    """The attribute that makes the onset, by the CF conventions, a coordinate of an episode's other variables."""
    if name.startswith("impacts/") and name != "impacts/onset":
        return {"coordinates": "onset"}
    return {}


def writers(output: Chunks) -> MPI.Comm:
    """The ranks that write together, or this one."""
    return output.comm if output.recording.together else MPI.COMM_SELF


def parts_to_copy(output: Chunks, number: int, wanted: Collection[str]) -> Iterator[Arrays]:
    """Arrays ``wanted`` of the parts of chunk ``number`` that fall to this rank: the writers take them in turn."""
    comm = writers(output)
    for rank in output.ranks(number):
        if rank % comm.size == comm.rank:
            yield output.read(number, rank, wanted)


def read_log(output: Chunks) -> np.ndarray:
    """The episodes (episode,) in the parts that fall to this rank, in no order; fields as in ``impacts``."""
    # Unsorted: episodes of several ranks are sorted once, when all are read.
    parts = [part for number in range(output.count) for part in parts_to_copy(output, number, ["impacts"])]
    return np.concatenate([part["impacts"] for part in parts])


def log_columns(log: np.ndarray, first: int = 0) -> Arrays:
    """The variables of the episodes ``log`` (episode,), which are in order and come after ``first`` others."""
    names = log.dtype.names or ()
    columns: dict[str, np.ndarray] = {"episode": np.arange(first, first + len(log)) + 1}
    for name in names:
        columns[f"impacts/{name}"] = log[name]
    return columns


def put_chunks(dataset: h5py.Dataset, output: Chunks, name: str) -> None:
    """Copy what ``name`` is, of sites or a field, of all chunks to ``dataset``; each writer copies what it reads."""
    time = "field_time"
    places = "columns"
    if name in output.recording.of_sites:
        time = "time"
        places = "sites"

    first = 0
    for number in range(output.count):
        rows = output.read(number, 0, [time])[time].size
        for part in parts_to_copy(output, number, [name, places]):
            # Parts have cells last, as the compiled engine fills them; the file has (sample, cell, dof).
            values = np.moveaxis(part[name], -1, 1)
            column = 0
            for start, stop in part[places].tolist():
                # h5py leaves out empty selections, on which writing together would hang.
                if rows and start < stop:
                    dataset[first : first + rows, start:stop] = values[:, column : column + stop - start]
                column += stop - start
        first += rows
