"""The one layout of every HDF5 file: netCDF-4, as xarray reads and writes it, from a flat ``xarray.Dataset``.

The name of a variable is its path in the file: ``energy/kinetic`` is the dataset ``kinetic`` of the group ``energy``.
The name of a dimension is the path of its coordinate, which is the HDF5 dimension scale: ``time`` for all groups,
``bands/part`` for one of them. An attribute of a group is ``entropy/start``.

The dataset is flat rather than a ``DataTree`` because there a group inherits the coordinates of its parent:
``tree["sites/cell"]`` would be the coordinate ``/cell``, not the variable of the group ``sites``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Hashable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeAlias

import h5py
import numpy as np

from vipetsc.io.atomic import atomic_write
from vipetsc.io.errors import ResultFileError, UnreadableFileError

# xarray loads pandas, which takes as long as all else that a command needs before it begins: functions import it.
if TYPE_CHECKING:
    import xarray as xr

Variables: TypeAlias = "dict[str, xr.Variable]"
"""Variables of a dataset by name."""


def variable(dims: str | Sequence[str], values: Any, units: str, long_name: str, **attributes: Any) -> xr.Variable:
    """``values`` over the named dimensions, with ``units``, ``long_name`` and further attributes."""
    import xarray as xr

    return xr.Variable(dims, np.asarray(values), {"units": units, "long_name": long_name, **attributes})


def tabulated(layout: Mapping[str, tuple[str, str, str]], values: Mapping[str, Any]) -> Variables:
    """``values`` by name as variables, whose dimensions (separated by blanks), units and texts ``layout`` gives."""
    variables = {}
    for name, value in values.items():
        dims, units, long_name = layout[name]
        variables[name] = variable(dims.split(), value, units, long_name)
    return variables


def write_netcdf(path: str | Path, data: xr.Dataset) -> None:
    """Write ``data`` to ``path``, whole or not at all; an attribute that is a dict or a list becomes JSON.

    Raises OSError if the file cannot be written, ValueError if a dimension has no coordinate.
    """
    # HDF5 crashes after a full disk: it works in memory, and Python writes what comes out.
    with h5py.File(Path(path).name, "w", driver="core", backing_store=False) as file:
        put_dataset(file, data)
        file.flush()
        image = file.id.get_file_image()
    with atomic_write(Path(path)) as aside:
        aside.write_bytes(image)


def put_dataset(file: h5py.File, data: xr.Dataset, write: bool = True) -> None:
    """Lay out ``data`` in ``file``; all ranks that have it open must call it, and one of them has to ``write``."""
    # Coordinates first: variables are attached to their scales.
    names = [*data.indexes, *(name for name in data.variables if name not in data.indexes)]
    for name in names:
        item = data.variables[name]
        values = item.values
        dtype = h5py.string_dtype() if values.dtype.kind in "UO" else values.dtype
        dataset = add_variable(file, name, item.dims, values.shape, dtype, item.attrs)
        if write and values.size:
            dataset[...] = values.astype(object) if values.dtype.kind == "U" else values

    for path, value in data.attrs.items():
        group, _, key = str(path).rpartition("/")
        node = file.require_group(group) if group else file
        node.attrs[key] = json.dumps(value) if isinstance(value, dict | list) else value


def add_variable(
    file: h5py.File, name: Hashable, dims: Sequence[Hashable], shape: Sequence[int], dtype: Any, attributes: Any
) -> h5py.Dataset:
    """Add an empty dataset over coordinates added before; it is a coordinate itself if its one dimension has its name.

    Its group gets soft links to coordinates outside it: programs that open the group alone find them there. Raises
    ValueError if a dimension has no coordinate.
    """
    path = PurePosixPath(str(name))
    if name in file:
        del file[str(name)]  # such a link
    dataset = file.create_dataset(str(name), tuple(shape), dtype)
    if tuple(dims) == (name,):
        dataset.make_scale(path.name)
    else:
        for axis, dim in enumerate(dims):
            if dim not in file:
                raise ValueError(f"{name}: its dimension {dim} has no coordinate")
            dataset.dims[axis].attach_scale(file[str(dim)])
            link = path.parent / PurePosixPath(str(dim)).name
            if str(link) not in file:
                file[str(link)] = h5py.SoftLink(f"/{dim}")
    dataset.attrs.update(attributes)
    return dataset


def open_netcdf(path: str | Path, kind: str, needs: Sequence[str] = ()) -> xr.Dataset:
    """Open a file as a flat dataset, a context manager; values are read when they are used.

    Messages call the file a ``kind``, as "run" or "branch"; ``needs`` are the variables (by path), groups and root
    attributes that a file of this kind must have. Raises UnreadableFileError, an OSError, if the file cannot be opened
    as HDF5, ResultFileError, a ValueError, if it is not of this kind.
    """
    import xarray as xr

    sys.audit("vipetsc.read", str(path))
    try:
        groups = xr.open_groups(path, engine="h5netcdf", phony_dims="access", decode_cf=False)
        links = _links(path)
    # Files of other programs have types and links that h5netcdf does not know, and meets with any exception.
    except Exception as error:
        raise _unreadable(path, kind, error) from error
    data = _flat(groups, links)
    closing = ExitStack()
    for group in groups.values():
        closing.callback(group.close)
    data.set_close(closing.close)

    present: set[str] = set()  # variables and groups
    for name in data.variables:
        path_in_file = PurePosixPath(str(name))
        present |= {str(part) for part in (path_in_file, *path_in_file.parents)}
    missing = [name for name in needs if name not in present and name not in data.attrs]
    if missing:
        data.close()  # nobody else would
    _refuse_other_kinds(path, kind, missing)
    return data


def root_attributes(path: str | Path, kind: str, needs: Sequence[str] = ()) -> dict[str, Any]:
    """The attributes of a file's root, for readers of nothing else: ``open_netcdf`` looks at every variable.

    Parameters and errors are those of ``open_netcdf``.
    """
    sys.audit("vipetsc.read", str(path))
    try:
        with h5py.File(path) as file:
            attributes = dict(file.attrs)
            missing = [name for name in needs if name not in file and name not in attributes]
    # Files of other programs have types that h5py does not know, and meets with any exception.
    except Exception as error:
        raise _unreadable(path, kind, error) from error
    _refuse_other_kinds(path, kind, missing)
    return attributes


def _unreadable(path: str | Path, kind: str, error: Exception) -> UnreadableFileError:
    """The error that reports that a file cannot be opened as HDF5, because of ``error``."""
    reason = "another program has it open for writing" if "unable to lock" in str(error) else error
    return UnreadableFileError(f"{path} cannot be opened as a {kind}: {reason}")


def _refuse_other_kinds(path: str | Path, kind: str, missing: Sequence[str]) -> None:
    """Raise ResultFileError for a file in which something is ``missing`` that every file of its ``kind`` has."""
    if missing:
        raise ResultFileError(f"{path} is not a {kind} of vipetsc: it lacks {', '.join(missing)}")


def _links(path: str | Path) -> set[PurePosixPath]:
    """The soft links in a file, to coordinates outside a group."""
    with h5py.File(path) as file:
        groups = [file]

        def collect(_: str, item: h5py.Group | h5py.Dataset) -> None:
            if isinstance(item, h5py.Group):
                groups.append(item)

        file.visititems(collect)
        links = set()
        for group in groups:
            for key in group:
                if isinstance(group.get(key, getlink=True), h5py.SoftLink):
                    links.add(PurePosixPath(group.name) / key)
    return links


def _flat(groups: dict[str, xr.Dataset], links: Collection[PurePosixPath]) -> xr.Dataset:
    """All groups in one dataset, names of variables, dimensions and attributes by their paths; ``links`` are left out.

    The coordinate of a dimension stands in the same group, or in the nearest one that holds it.
    """
    import xarray as xr

    nodes: dict[PurePosixPath, xr.Dataset] = {}
    scales: set[PurePosixPath] = set()
    for group, data in groups.items():
        node = PurePosixPath(group)
        nodes[node] = data.drop_vars([link.name for link in links if link.parent == node])
        scales |= {node / str(name) for name, item in nodes[node].variables.items() if item.dims == (name,)}

    def coordinate(node: PurePosixPath, dim: Hashable) -> str:
        """The path of the coordinate of a dimension in a group; without a coordinate, its path in this group."""
        candidates = [group / str(dim) for group in (node, *node.parents)]
        nearest = next((path for path in candidates if path in scales), candidates[0])
        return str(nearest).strip("/")

    variables: dict[str, xr.Variable] = {}
    attributes: dict[str, Any] = {}
    for node, data in nodes.items():
        for name, item in data.variables.items():
            renamed = item.copy(deep=False)  # values stay in the file
            renamed.dims = tuple(coordinate(node, dim) for dim in item.dims)
            variables[str(node / str(name)).strip("/")] = renamed
        attributes |= {str(node / str(key)).strip("/"): value for key, value in data.attrs.items()}
    return xr.Dataset(variables, attrs=attributes)
