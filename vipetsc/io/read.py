"""Results read with xarray: a run, and the ensemble of a sweep.

``open_run`` gives the tree of ``run.h5``: ``run["velocity"]``, ``run["energy/kinetic"]``, ``run["impacts/onset"]``;
fields are read where they are sliced. ``open_ensemble`` gives one dataset with a dimension for every axis of a sweep;
``select`` picks members by the values of swept keys. Cells and sites count from 1, units stand in the attributes.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xarray as xr

Selectable = TypeVar("Selectable", xr.Dataset, xr.DataArray)


def open_tree(path: str | Path, kind: str, needs: tuple[str, ...] = ()) -> xr.DataTree:
    """The groups of an HDF5 file of ours, for reading; use it as a context manager or close it.

    Parameters
    ----------
    kind
        What the file should be, for the message: "a run".
    needs
        Variables and groups that it has to hold, besides the attribute ``case``.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If something that it needs is missing.
    """
    tree = xr.open_datatree(path, engine="h5netcdf", decode_times=False)
    missing = [name for name in needs if not holds(tree, name)]
    missing += [] if "case" in tree.attrs else ["case"]
    if missing:
        tree.close()
        raise ValueError(f"{path} is not {kind} of vipetsc: it has no {', '.join(missing)}")
    for node in tree.subtree:
        # A variable that is named like a coordinate of a group above, such as sites/cell, would be hidden by it.
        own = node.to_dataset(inherit=False)
        hidden = [name for name in own.data_vars if name in node.coords]
        if hidden:
            node.dataset = own.set_coords(hidden)
    return tree


def holds(tree: xr.DataTree, *names: str) -> bool:
    """Whether ``tree`` has all these variables or groups; a name may be a path, such as ``bands/energy``."""
    try:
        return all(tree[name] is not None for name in names)
    except KeyError:
        return False


def values(tree: xr.DataTree, name: str) -> np.ndarray:
    """The array of the variable ``name``; raises KeyError."""
    variable = tree[name]
    if isinstance(variable, xr.DataTree):
        raise KeyError(f"{name} is a group, not a variable")
    return np.asarray(variable.values)


def open_run(path: str | Path) -> xr.DataTree:
    """The run in ``path``; raises OSError or ValueError as ``open_tree``."""
    return open_tree(path, "a run", ("time", "cell", "energy"))


def field_time(run: xr.DataTree) -> np.ndarray:
    """Times (t) in s of the fields: ``time``, or every n-th of it."""
    return values(run, "field_time" if "field_time" in run else "time")


def field_interval(run: xr.DataTree) -> float:
    """Sampling interval of the fields in s; NaN for a single sample."""
    time = field_time(run)
    return float(time[1] - time[0]) if len(time) > 1 else np.nan


def leading_site(run: xr.DataTree) -> int | None:
    """Index (0-based) of the site nearest to the drive, which the wave reaches first; None without sites."""
    cells = values(run, "sites/cell")
    drive = tomllib.loads(run.attrs["case"])["drive"]["cell"]
    return int(np.argmin(np.abs(cells - drive))) if len(cells) else None


def nearest_cell(run: xr.DataTree, cell: int) -> int:
    """Index (0-based) of the recorded cell nearest to ``cell`` (1-based)."""
    return int(np.argmin(np.abs(values(run, "cell") - cell)))


def open_ensemble(folder: str | Path) -> xr.Dataset:
    """The ensemble of the sweep in ``folder``, read whole: measures over one dimension a swept axis.

    A dimension is named after its axis' first key; further keys of a zipped axis are coordinates on it. Variables of
    groups keep their path as name (``entropy/masked``, ``fits/ibtet/exponent``). ``member`` is the name of each
    member's folder, empty where the case of a member is no valid one; the attribute ``folder`` is the sweep's.

    Raises
    ------
    OSError
        If ``ensemble.h5`` or ``index.json`` cannot be read.
    ValueError
        If it is no ensemble of ours.
    """
    folder = Path(folder)
    with open_tree(folder / "ensemble.h5", "an ensemble", ("status",)) as tree:
        variables = {}
        for node in tree.subtree:
            for name, variable in node.to_dataset(inherit=False).data_vars.items():
                variables[f"{node.path}/{name}".strip("/")] = variable
        data = xr.Dataset(variables, tree.coords, tree.attrs | {"folder": str(folder)}).load()
    keys = [key for group in tomllib.loads(data.attrs["case"])["sweep"]["zip"] for key in group]
    data = data.set_coords(
        [name for name, variable in data.data_vars.items() if variable.attrs.get("long_name") in keys]
    )
    rows = json.loads((folder / "index.json").read_text(encoding="utf-8"))["members"]
    ids = np.array([row["id"] for row in rows], dtype=object).reshape(data["status"].shape)
    return data.assign(member=(data["status"].dims, ids, {"long_name": "name of the member's folder"}))


def select(data: Selectable, **wanted: Any) -> Selectable:
    """The first member of ``data`` with these values of swept keys, on each of their axes; other axes stay.

    ``select(ensemble, law="hertz", sites=5, cycles=30)["ibtet"]``. Keys of one zipped axis have to meet in one
    member; numbers match to a relative 1e-5.

    Raises
    ------
    KeyError
        If a name is no coordinate, or no member has the values.
    """
    matches: dict[str, np.ndarray] = {}
    for name, value in wanted.items():
        if name not in data.coords or data[name].ndim != 1:
            raise KeyError(f"{name} is no coordinate; there are {', '.join(map(str, data.coords))}")
        coordinate = data[name].values
        numeric = np.issubdtype(coordinate.dtype, np.number)
        match = np.isclose(coordinate, value, rtol=1e-5, atol=0) if numeric else coordinate == value
        dimension = str(data[name].dims[0])
        matches[dimension] = matches.get(dimension, np.array(True)) & match
        if not matches[dimension].any():
            others = [n for n in wanted if n != name and n in data.coords and data[n].dims == data[name].dims]
            beside = f" beside {', '.join(others)}" if others else ""
            raise KeyError(f"no member has {name} = {value!r}{beside}; there are {list(coordinate)}")
    return data.isel({dimension: int(np.argmax(match)) for dimension, match in matches.items()})


def axes(ensemble: xr.Dataset) -> tuple[str, ...]:
    """Names of the sweep's axes in the order of its case."""
    return tuple(map(str, ensemble["status"].dims))


def member_folder(member: xr.Dataset) -> Path | None:
    """Folder of one member (``case.toml``, ``run.h5``, ``analysis.h5``); None where its case was no valid one."""
    identity = str(member["member"].item())
    return Path(member.attrs["folder"]) / identity if identity else None


def curves(ensemble: xr.Dataset, along: str = "amplitude") -> Iterator[tuple[xr.Dataset, Path]]:
    """Every curve over the axis ``along``, and the folder of its first member with a valid case.

    Nothing if the sweep has no such axis.
    """
    others = [name for name in axes(ensemble) if name != along]
    if len(others) == len(axes(ensemble)):
        return
    for index in np.ndindex(*(ensemble.sizes[name] for name in others)):
        curve = ensemble.isel(dict(zip(others, index, strict=True)))
        folders = [member_folder(curve.isel({along: i})[["member"]]) for i in range(curve.sizes[along])]
        first = next((folder for folder in folders if folder), None)
        if first:
            yield curve, first


def whole_members(ensemble: xr.Dataset) -> Iterator[tuple[xr.Dataset, Path]]:
    """The members whose fields were kept, and their folders."""
    if not tomllib.loads(ensemble.attrs["case"])["sweep"]["fields"]:
        return
    for index in np.ndindex(*ensemble["status"].shape):
        member = ensemble.isel(dict(zip(axes(ensemble), index, strict=True)))
        folder = member_folder(member)
        if folder and (folder / "run.h5").exists() and (folder / "analysis.h5").exists():
            yield member, folder
