"""Reading of results with xarray: a run, the ensemble of a sweep; names are paths in the file, as in ``io.netcdf``.

``open_run`` gives a dataset with ``run["velocity"]``, ``run["energy/kinetic"]``, ``run["impacts/onset"]``.
``open_ensemble`` gives the measures of a sweep with a dimension for each axis; ``select`` picks members by the values
of swept keys. Cells and sites are counted from 1; each variable has its unit as an attribute.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vipetsc.io.kinds import BRANCHES, RUN, STUDIES, SWEEP
from vipetsc.io.netcdf import open_netcdf

if TYPE_CHECKING:
    import xarray as xr

# Files that ``open_results`` opens if a folder is given: the first one that exists.
FIRST = (RUN.file, *(kind.file for kind in STUDIES), "analysis.h5")
# What the file of every run has: its times, cells and case, and for its energies, sites and episodes all variables.
RUN_NEEDS = (
    *("time", "cell", "dof", "case"),
    *(f"energy/{name}" for name in ("kinetic", "spring", "contact", "work", "dissipated", "dissipated_by_site")),
    *(f"sites/{name}" for name in ("cell", "clearance")),
    *(f"impacts/{name}" for name in ("site", "side", "onset", "approach_velocity", "separation")),
    *(f"impacts/{name}" for name in ("indentation", "force", "impulse", "loss")),
)
STRIP = "[lattice.cell.from_strip]"  # in the case of a run on a strip of the plane
PARTS = "bands/part", "part"  # dimensions of pass bands and the gaps between them, of one run and of a sweep
Selectable = TypeVar("Selectable", "xr.Dataset", "xr.DataArray")


def open_run(path: str | Path) -> xr.Dataset:
    """Open the run in ``path``, a context manager: fields are read when they are sliced.

    ``encoding["source"]`` is the path. Raises OSError or ValueError as ``open_netcdf``.
    """
    run = open_netcdf(path, "run", RUN_NEEDS)
    run = with_rows(with_point_names(run))
    run.encoding["source"] = str(path)
    return run


def with_point_names(run: xr.Dataset) -> xr.Dataset:
    """Return the ``run`` with the names of its points, from its case, as the coordinate ``point``, for ``sel``.

    Other results come back as they are.
    """
    # A branch has a dimension of this name too, over its own points, which have no names.
    if not any(str(name).startswith("points/") for name in run.variables):
        return run
    names = [point["name"] for point in tomllib.loads(run.attrs["case"])["output"]["points"]]
    return _renamed(run, "point", names)


def with_rows(run: xr.Dataset) -> xr.Dataset:
    """Return ``run`` of a strip of the plane with the ``row`` and the ``mass`` of each dof, and the row of each site.

    Both count from 1; ``mass`` is the degree of freedom in a cell of the plane. Other results come back as they are.
    """
    # Only the case of a strip is read: its text is long.
    if STRIP not in str(run.attrs.get("case")) or "dof" not in run.dims or "sites/cell" not in run:
        return run
    case = tomllib.loads(run.attrs["case"])
    dofs = run.sizes["dof"] // case["lattice"]["cell"]["from_strip"].get("rows", 1)
    number = np.arange(run.sizes["dof"])
    named = run.assign_coords(row=("dof", number // dofs + 1), mass=("dof", number % dofs + 1))
    contacts = case["contacts"]
    pairs = contacts.get("each", {}).get("pair") or [contacts.get("pair", [1, 2])] * run.sizes["site"]
    rows = [(resonator - 1) // dofs + 1 for _, resonator in pairs]
    about = {"units": "1", "long_name": "row of the strip in which the site's resonator is"}
    named["sites/row"] = ("site", np.array(rows, np.int64), about)
    named.set_close(run.close)
    return named


def with_part_names(analysis: xr.Dataset) -> xr.Dataset:
    """Return the ``analysis`` of a run or sweep with the names of the parts of the frequency axis as coordinate.

    A part is, for instance, "band 2". Other results come back as they are.
    """
    for item in analysis.variables.values():
        names = np.atleast_1d(item.attrs.get("parts", ()))
        for dimension in PARTS:
            if dimension in item.dims and len(names) == analysis.sizes[dimension]:
                return _renamed(analysis, dimension, names.tolist())
    return analysis


def _renamed(data: xr.Dataset, dimension: str, names: list[str]) -> xr.Dataset:
    """Return the ``data`` with ``names`` as the coordinate of a ``dimension``."""
    attributes = data[dimension].attrs
    named = data.assign_coords({dimension: (dimension, np.array(names, dtype=object), attributes)})
    # A dataset that is made from another one does not close its file.
    named.set_close(data.close)
    return named


def open_results(path: str | Path) -> xr.Dataset:
    """Open a file of results, or the first of ``FIRST`` in a folder, as ``vipetsc.open`` does; a context manager.

    Names are paths in the file, units attributes of the variables, the resolved case (TOML) is ``attrs["case"]``;
    ``Case.of`` reads it. Episodes of a run have their ``impacts/onset`` as a coordinate. Raises ValueError for a folder
    without results or with several branches, and as ``open_netcdf``.
    """
    path = Path(path)
    if path.is_dir() and (path / SWEEP.file).exists():
        return with_part_names(open_ensemble(path))

    files = [path]
    if path.is_dir():
        present = [path / name for name in FIRST if (path / name).exists()]
        files = present[:1] or sorted(path.glob(BRANCHES.file))
    if len(files) != 1:
        contents = ", ".join(file.name for file in files) or "no results"
        raise ValueError(f"{path}: contains {contents}; name a file")

    data = open_netcdf(files[0], "result", needs=("case",))
    data = with_part_names(with_rows(with_point_names(data)))
    data.encoding["source"] = str(files[0])
    return data.set_coords([name for name in ("impacts/onset",) if name in data])


def field_time(run: xr.Dataset) -> np.ndarray:
    """Return times (t,) in s of the fields of a ``run``: those of all samples, or of every n-th."""
    if "field_time" in run:
        return run["field_time"].values
    return run["time"].values


def field_interval(run: xr.Dataset) -> float:
    """Return the interval in s between the fields of a ``run``; NaN for a single field."""
    time = field_time(run)
    if len(time) < 2:
        return np.nan
    return float(time[1] - time[0])


def nearest_cell(run: xr.Dataset, cell: int) -> int:
    """Return the index (0-based) of the recorded cell nearest to ``cell`` (1-based)."""
    return int(np.argmin(np.abs(run["cell"].values - cell)))


def open_ensemble(folder: str | Path) -> xr.Dataset:
    """Return the ensemble of the sweep in ``folder``, read completely: measures with one dimension per swept axis.

    A dimension is named after the first key of its axis; further keys of a zipped axis are coordinates over it. The
    variable ``number`` counts the members from 0, the attribute ``folder`` is the path of the sweep's. Raises OSError
    if ``ensemble.h5`` cannot be read, ValueError if it is no ensemble.
    """
    folder = Path(folder)
    with open_netcdf(folder / "ensemble.h5", "sweep's ensemble", ("status", "case")) as file:
        # All values at once: they are small, and the file is closed here.
        data = file.assign_attrs(folder=str(folder)).load()

    zipped = [key for group in tomllib.loads(data.attrs["case"])["sweep"]["zip"] for key in group]
    further = [name for name, variable in data.data_vars.items() if variable.attrs.get("long_name") in zipped]
    data = data.set_coords(further)
    number = np.arange(data["status"].size).reshape(data["status"].shape)
    return data.assign(number=(data["status"].dims, number, {"long_name": "number of the member, counted from 0"}))


def over_samples(ensemble: xr.Dataset) -> xr.Dataset:
    """Return the ``ensemble`` without its axis of disorder samples, if any, measures being means over these.

    A measure of which there is no mean is that of the first sample; ``statistics/<name>/quantiles`` stay.
    """
    if "statistics/samples" not in ensemble:
        return ensemble
    (seed,) = (dim for dim in axes(ensemble) if ensemble[dim].attrs["long_name"] == "disorder.seed")
    first = ensemble.isel({seed: 0}, drop=True)
    means = {}
    for name in map(str, ensemble.data_vars):
        for path in (f"statistics/{name}/mean", f"statistics/{name}"):
            if path in first:
                means[name] = first[path].assign_attrs(ensemble[name].attrs)
    return first.assign(means)


def select(data: Selectable, **wanted: Any) -> Selectable:
    """Return part of ``data`` at the ``wanted`` values of swept keys, the first of several; axes without a value stay.

    For example ``select(ensemble, law="hertz", sites=5, cycles=30)["ibtet"]``. Of keys that vary together, along one
    axis, one member must have all values. Numbers match to a relative 1e-5. Raises KeyError if a name is no coordinate
    over one dimension, or no member has the values.
    """
    # Which positions along a dimension have all values so far: keys of a zipped axis have a dimension in common.
    matches: dict[str, np.ndarray] = {}
    for name, value in wanted.items():
        if name not in data.coords or data[name].ndim != 1:
            raise KeyError(f"{name} is not a coordinate; the coordinates are {', '.join(map(str, data.coords))}")

        coordinate = data[name].values
        if np.issubdtype(coordinate.dtype, np.number) and isinstance(value, int | float | np.number):
            # To five digits, since a user types what messages print; amplitudes of one sweep lie further apart.
            match = np.isclose(coordinate, value, rtol=1e-5, atol=0)
        else:
            match = np.array([item == value for item in coordinate.tolist()])
        dimension = str(data[name].dims[0])
        matches[dimension] = matches.get(dimension, np.array(True)) & match
        if not matches[dimension].any():
            sought = f"{name} = {value!r}"
            others = [n for n in wanted if n != name and n in data.coords and data[n].dims == data[name].dims]
            if others:
                sought += f" at the given {', '.join(others)}"
            raise KeyError(f"no member has {sought}; the values are {coordinate.tolist()}")

    return data.isel({dimension: int(np.argmax(match)) for dimension, match in matches.items()})


def axes(ensemble: xr.Dataset) -> tuple[str, ...]:
    """Return names of the sweep's axes in the order of its case."""
    return tuple(map(str, ensemble["status"].dims))


def member_folder(member: xr.Dataset) -> Path:
    """Return the folder that has the ``run.h5`` and ``analysis.h5`` of one member if its fields were kept."""
    return Path(member.attrs["folder"]) / str(member["member"].item())


def curves(ensemble: xr.Dataset, along: str = "amplitude") -> Iterator[tuple[xr.Dataset, int]]:
    """Yield every curve of an ``ensemble`` over its axis ``along``, and the number of its first member that succeeded.

    A curve of which no member succeeded is left out; a sweep without that axis has no curves.
    """
    others = [name for name in axes(ensemble) if name != along]
    if len(others) == len(axes(ensemble)):
        return
    for index in np.ndindex(*(ensemble.sizes[name] for name in others)):
        curve = ensemble.isel(dict(zip(others, index, strict=True)))
        # A member that failed has NaN for every measure, and every other member has this one.
        succeeded = curve["number"].values[np.isfinite(curve["contact_episodes"].values)]
        if succeeded.size:
            yield curve, int(succeeded[0])


def whole_members(ensemble: xr.Dataset) -> Iterator[tuple[xr.Dataset, Path]]:
    """Yield the members whose fields were kept, and their folders."""
    if not tomllib.loads(ensemble.attrs["case"])["sweep"]["fields"]:
        return
    for index in np.ndindex(*ensemble["status"].shape):
        member = ensemble.isel(dict(zip(axes(ensemble), index, strict=True)))
        folder = member_folder(member)
        if (folder / "run.h5").exists() and (folder / "analysis.h5").exists():
            yield member, folder
