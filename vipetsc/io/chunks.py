"""The variables of ``run.h5``, and their assembly from the chunks of a run.

A chunk holds the samples between two checkpoints, as arrays by name:

- fields (sample, dof, cell) such as ``displacement``, of the recorded cells;
- losses and forces (sample, site);
- ``impacts`` (episode,), a record of each contact episode that ended in the chunk; in the last chunk also of those that
  are still open;
- what belongs to a sample as a whole (``SAMPLED``, ``DAMPING`` and ``MOTION``).
"""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import h5py
import numpy as np

from vipetsc.io.hdf5 import Arrays
from vipetsc.io.netcdf import tabulated

if TYPE_CHECKING:
    import xarray as xr

# Variables of the file by name: dimensions, units, text.
# ``SAMPLED``, ``DAMPING`` and ``MOTION`` are known for every sample; ``GIVEN`` is known before the first one.
# ``LARGE`` are fields, losses, forces and the log of contacts.
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
    "impacts/impulse": ("episode", "N s", "integral of the contact force over the episode"),
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

    Attributes
    ----------
    given
        The arrays of ``GIVEN`` by name.
    fields
        Names of the fields that are recorded.
    rows
        Number of samples in a field of the whole run.
    sampled
        Names of the variables that rank 0 has of every sample, from ``SAMPLED``, ``DAMPING`` and ``MOTION``.
    of_sites
        Names of the variables over (time, site), from ``LOSSES`` and ``FORCES``.
    """

    given: Arrays
    fields: tuple[str, ...]
    rows: int
    sampled: Collection[str] = tuple(SAMPLED)
    of_sites: tuple[str, ...] = (LOSSES,)


class Chunks(Protocol):
    """The ``count`` chunks of a run, from which ``read`` reads arrays."""

    case: str
    count: int
    recording: Recording

    def read(self, number: int, wanted: Collection[str]) -> Arrays: ...  # noqa: D102


def joined(output: Chunks, names: Collection[str]) -> dict[str, np.ndarray]:
    """Return the arrays ``names`` (sample, ...), all chunks one after the other."""
    chunks = [output.read(number, names) for number in range(output.count)]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names}


def small_variables(output: Chunks) -> dict[str, Any]:
    """Return the variables of ``GIVEN`` and of all that rank 0 has of every sample, by name, as a dataset takes them.

    The fields' own times are left out where the fields are of every sample.
    """
    arrays = {**joined(output, output.recording.sampled), **output.recording.given}
    if len(arrays["field_time"]) == len(arrays["time"]):
        del arrays["field_time"]
    return dict(tabulated(SAMPLED | DAMPING | MOTION | GIVEN, arrays))


def run_dataset(output: Chunks, variables: Mapping[str, Any], attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return the dataset of a run's ``variables``, with its case and the ``attributes`` as its own."""
    import xarray as xr

    return xr.Dataset(variables, attrs={"case": output.case, **attributes})


class Description(NamedTuple):
    """Dimensions and attributes of a variable."""

    dims: list[str]
    attributes: dict[str, str]


def described(name: str, data: Container[Any]) -> Description:
    """Return the description of the variable ``name`` of ``LARGE`` in a file that holds the small variables ``data``.

    Fields are over ``time`` if the file has no times of the fields alone.
    """
    dims, units, text = LARGE[name]
    if "field_time" not in data:
        dims = dims.replace("field_time", "time")
    return Description(dims=dims.split(), attributes={"units": units, "long_name": text})


def coordinates(name: str) -> dict[str, str]:
    """Return attribute that makes the onset, by the CF conventions, a coordinate of an episode's other variables."""
    if name.startswith("impacts/") and name != "impacts/onset":
        return {"coordinates": "onset"}
    return {}


def read_log(output: Chunks) -> np.ndarray:
    """Return the episodes (episode,) of all chunks, sorted by onset; a record has the fields of ``impacts``."""
    log = np.concatenate([output.read(number, ["impacts"])["impacts"] for number in range(output.count)])
    return log[np.lexsort([log["site"], log["onset"]])]


def log_columns(log: np.ndarray) -> Arrays:
    """Return the variables (episode,) of the file for the sorted episodes ``log`` (episode,)."""
    columns: dict[str, np.ndarray] = {"episode": np.arange(len(log)) + 1}
    for name in log.dtype.names or ():
        columns[f"impacts/{name}"] = log[name]
    return columns


def part_of(file: h5py.File, number: int, count: int) -> Arrays:
    """Return chunk ``number`` of the ``count`` chunks into which the samples of a run's ``file`` are divided again.

    Episodes that were open at the end of the run are left out: they go on.
    """

    def part(name: str) -> np.ndarray:
        values = file[name]
        n = len(values)
        return np.asarray(values[n * number // count : n * (number + 1) // count])

    present = [name for name in (*SAMPLED, DAMPED, *MOTION, LOSSES, FORCES) if name in file]
    arrays = {name: part(name) for name in present}
    arrays.setdefault("field_time", arrays["time"])
    fields = [name for name in ("displacement", "velocity") if name in file]
    arrays |= {name: np.moveaxis(part(name), 1, -1) for name in fields}

    columns = {name.removeprefix("impacts/"): part(name) for name in LARGE if name.startswith("impacts/")}
    log = np.zeros(len(columns["onset"]), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        log[name] = values
    arrays["impacts"] = log[np.isfinite(log["separation"])]
    return arrays


def put_chunks(datasets: Mapping[str, h5py.Dataset], output: Chunks) -> None:
    """Copy the variables to which ``datasets`` belong, fields or over sites, from all chunks.

    A field becomes (sample, cell, dof), what is over sites (sample, site).
    """
    first = dict.fromkeys(datasets, 0)
    for number in range(output.count):
        arrays = output.read(number, datasets)
        for name, dataset in datasets.items():
            # Chunks have cells last, as the compiled engine fills them; the file has them after the samples.
            values = np.moveaxis(arrays[name], -1, 1)
            if values.size:
                dataset[first[name] : first[name] + len(values)] = values
            first[name] += len(values)
