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
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeAlias

import h5py
import numpy as np

from vipetsc.io.atomic import atomic_write
from vipetsc.io.errors import FolderError, ResultFileError, UnreadableFileError
from vipetsc.io.hdf5 import hdf5_file
from vipetsc.register import PartError
from vipetsc.wording import shortened, system_number, system_reason

# xarray loads pandas, which takes as long as all else that a command needs before it begins: functions import it.
if TYPE_CHECKING:
    import xarray as xr
    from xarray.backends import CachingFileManager

# An attribute: how many numbers of a variable were NaN or infinite by right when it was written, such as the end of a
# contact that is closed at the end of a run.
NOT_FINITE = "not_finite"
# Errors of calculations with numbers that are not finite, or with none.
OF_NUMBERS = (ValueError, IndexError, ArithmeticError, np.linalg.LinAlgError)
MAY_BE_EMPTY = ("site", "episode", "cluster")  # dimensions, of any group, of runs without sites, or without contact
Variables: TypeAlias = "dict[str, xr.Variable]"
"""Variables of a dataset by name."""
Node: TypeAlias = "h5py.Group | h5py.Dataset"

# Attributes by which HDF5 and netCDF-4 describe dimensions. Readers do not see them as attributes of a variable.
DIMENSION_ATTRIBUTES = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "DIMENSION_LABELS", "coordinates"}
DIMENSION_ATTRIBUTES |= {"_Netcdf4Dimid", "_Netcdf4Coordinates", "_nc3_strict", "_NCProperties"}
# The attribute NAME of a dimension without a coordinate begins so.
NO_COORDINATE = "This is a netCDF dimension but not a netCDF variable"


def variable(dims: str | Sequence[str], values: Any, units: str, long_name: str, **attributes: Any) -> xr.Variable:
    """Return ``values`` over the named dimensions, with ``units``, ``long_name`` and further attributes."""
    import xarray as xr

    return xr.Variable(dims, np.asarray(values), {"units": units, "long_name": long_name, **attributes})


def tabulated(layout: Mapping[str, tuple[str, str, str]], values: Mapping[str, Any]) -> Variables:
    """Return ``values`` by name as variables, with dimensions (separated by blanks), units and texts of ``layout``."""
    variables = {}
    for name, value in values.items():
        dims, units, long_name = layout[name]
        variables[name] = variable(dims.split(), value, units, long_name)
    return variables


def write_netcdf(path: str | Path, data: xr.Dataset) -> None:
    """Write ``data`` to ``path``, whole or not at all; an attribute that is a dict or a list becomes JSON.

    Raises OSError if the file cannot be written, ValueError if a dimension has no coordinate.
    """
    with atomic_write(Path(path)) as aside, hdf5_file(aside) as file:
        put_dataset(file, data)


def put_dataset(file: h5py.File, data: xr.Dataset) -> None:
    """Add the variables and attributes of ``data`` to ``file``; an attribute that is a dict or a list becomes JSON.

    Raises ValueError if a dimension has no coordinate, or the name of another one further up.
    """
    _check_dimensions(data)
    # Coordinates come first, because variables are attached to their scales.
    indexes = data.indexes
    variables = data.variables
    for name in [*indexes, *(name for name in variables if name not in indexes)]:
        item = variables[name]
        values = item.values
        dtype = values.dtype
        # HDF5 has no type for numpy's text of fixed width, and h5py takes texts of any length as objects.
        if dtype.kind in "UO":
            values = values.astype(object)
            dtype = h5py.string_dtype()
        attributes = {key: value for key, value in item.attrs.items() if key != NOT_FINITE}
        attributes |= not_finite_in(values)
        dataset = add_variable(file, name, item.dims, values.shape, dtype, attributes)
        if values.size:
            dataset[...] = values

    for path, value in data.attrs.items():
        group, _, key = str(path).rpartition("/")
        # HDF5 has attributes that are a number, a text or an array of either.
        if isinstance(value, dict | list):
            value = json.dumps(value)
        file.require_group(group or "/").attrs[key] = value


def not_finite_in(values: np.ndarray) -> dict[str, int]:
    """Return the attribute of a variable that counts those of its ``values`` that are NaN or infinite, if any are."""
    if values.dtype.kind not in "fc":
        return {}
    count = values.size - int(np.count_nonzero(np.isfinite(values)))
    return {NOT_FINITE: count} if count else {}


def _check_dimensions(data: xr.Dataset) -> None:
    """Raise ValueError for a dimension of a group that has the name of one of a group above it, or of the root.

    In a tree of groups, as ``xarray.open_datatree`` makes it, a group inherits the dimensions above it.
    """
    for name in map(str, data.dims):
        group, _, own_name = name.rpartition("/")
        while group:
            group = group.rpartition("/")[0]
            above = _path(group, own_name)
            if above in data.dims:
                raise ValueError(f"the dimension {name} has the name of the dimension {above}; choose another name")


def add_variable(
    file: h5py.File, name: Hashable, dims: Sequence[Hashable], shape: Sequence[int], dtype: Any, attributes: Any
) -> h5py.Dataset:
    """Add an empty dataset over dimensions whose coordinates are in the file already; return it.

    A dataset over one dimension of its own name is the coordinate of that dimension. In the group of a dataset there
    are soft links to coordinates outside it, which programs need that open the group alone. Raises ValueError if a
    dimension has no coordinate.
    """
    path = str(name)
    group, _, own_name = path.rpartition("/")
    if path in file:
        # A soft link to a coordinate of that name outside the group has its place.
        del file[path]

    # Two files of the same contents have the same bytes, whenever they are written.
    dataset = file.create_dataset(path, tuple(shape), dtype, track_times=False)
    if tuple(dims) == (name,):
        dataset.make_scale(own_name)
    else:
        for axis, dim in enumerate(map(str, dims)):
            if dim not in file:
                raise ValueError(f"{name}: its dimension {dim} has no coordinate")
            dataset.dims[axis].attach_scale(file[dim])
            link = _path(group, dim.rpartition("/")[2])
            if link not in file:
                file[link] = h5py.SoftLink(f"/{dim}")

    for key, value in attributes.items():
        dataset.attrs[key] = value
    return dataset


def open_netcdf(path: str | Path, kind: str, needs: Sequence[str] = ()) -> xr.Dataset:
    """Open a file as a flat dataset, a context manager; values are read when they are used.

    Messages call the file a ``kind``, as "run" or "branch"; ``needs`` are the variables (by path), groups and root
    attributes that a file of this kind must have. ``encoding["source"]`` is the path. Raises UnreadableFileError, an
    OSError, if the file cannot be opened as HDF5, ResultFileError, a ValueError, if it is not of this kind.
    """
    import xarray as xr
    from xarray.backends import CachingFileManager

    sys.audit("vipetsc.read", str(path))
    files = CachingFileManager(h5py.File, str(path), mode="r")
    try:
        variables, attributes = _contents(files)
        data = xr.Dataset(variables, attrs=attributes)
    # Files of other programs have types and links that h5py does not know, and meets with any exception. In some, a
    # dimension has two lengths, which xarray refuses.
    except Exception as error:
        files.close()
        raise _unreadable(path, kind, error) from error
    data.set_close(files.close)
    data.encoding["source"] = str(path)

    # Variables, and the groups that hold any.
    present: set[str] = set()
    for name in data.variables:
        path_in_file = PurePosixPath(str(name))
        present |= {str(part) for part in (path_in_file, *path_in_file.parents)}
    missing = [name for name in needs if name not in present and name not in data.attrs]
    if missing:
        # The error leaves the caller without a dataset to close.
        data.close()
    _refuse_other_kinds(path, kind, missing)
    return data


def root_attributes(path: str | Path, kind: str, needs: Sequence[str] = ()) -> dict[str, Any]:
    """Return the attributes of a file's root, for readers of nothing else: ``open_netcdf`` looks at every variable.

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
    """Return the error that reports that a file cannot be opened as HDF5, because of ``error``."""
    reason = system_reason(error)
    if "unable to lock" in str(error):
        reason = "another program has it open for writing"
    if isinstance(error, KeyError):
        reason = "it lacks the coordinate of a dimension of its variables"
    return UnreadableFileError(system_number(error), f"{path} cannot be opened as a {kind}: {reason}")


@contextmanager
def naming_spoilt(opened: Callable[[], Iterable[xr.Dataset]]) -> Iterator[None]:
    """Name what is not finite in results, or empty, where an error in the block may come from it.

    ``opened`` returns the results that the block has opened. Raises ResultFileError then. Errors that numbers do not
    cause stay as they are, as of files, memory and users' modules, and so does any other where all results are finite.
    """
    try:
        yield
    except (FolderError, PartError):
        raise
    except OF_NUMBERS as error:
        reasons = [text for data in opened() for text in _spoilt(data)]
        if not reasons:
            raise
        cause = f"{'; '.join(reasons)}, which may be the cause: compute the results again"
        raise ResultFileError(f"{type(error).__name__}: {error}; {cause}") from error


def _spoilt(data: xr.Dataset) -> list[str]:
    """Return sentences on variables of ``data`` with numbers that are no longer finite, and on empty dimensions."""
    file = data.encoding.get("source", "the file")
    infinite = []
    for name, item in data.variables.items():
        if not_finite_in(item.values).get(NOT_FINITE, 0) != item.attrs.get(NOT_FINITE, 0):
            infinite.append(str(name))
    without = [str(name) for name, size in data.sizes.items() if size == 0]
    empty = [name for name in without if name.rpartition("/")[2] not in MAY_BE_EMPTY]
    sentences = []
    if infinite:
        sentences.append(f"{file} holds numbers that are not finite in {shortened(infinite)}")
    if empty:
        sentences.append(f"{file} holds no {shortened(empty)}")
    return sentences


def _refuse_other_kinds(path: str | Path, kind: str, missing: Sequence[str]) -> None:
    """Raise ResultFileError for a file in which something is ``missing`` that every file of its ``kind`` has."""
    if missing:
        raise ResultFileError(f"{path} is not a {kind} of vipetsc: it lacks {shortened(missing)}")


def _contents(files: CachingFileManager) -> tuple[Variables, dict[str, Any]]:
    """Return variables of all groups of the file that ``files`` opens, and the groups' attributes, by their paths."""
    import xarray as xr
    from xarray.core import indexing

    from vipetsc.io.stored_array import StoredArray

    variables: Variables = {}
    attributes: dict[str, Any] = {}
    with files.acquire_context() as file:
        nodes = dict(_nodes("", file))
        # Nodes are equal where they are the same object: for the name of an object HDF5 would search the whole file.
        paths = {node: path for path, node in nodes.items()}

        for path, node in nodes.items():
            stored = _stored_attributes(node)
            described = {key: value for key, value in stored.items() if key not in DIMENSION_ATTRIBUTES}
            if isinstance(node, h5py.Group):
                attributes |= {_path(path, key): value for key, value in described.items()}
                continue
            if str(stored.get("NAME")).startswith(NO_COORDINATE):
                continue

            dims = _dimensions(path, node, stored, paths)
            # Texts are read at once: they are few, and the type of numpy's array depends on the longest. So are
            # coordinates, of which xarray makes indexes.
            if h5py.check_string_dtype(node.dtype):
                data = node.asstr()[...].astype(str)
            elif dims == [path]:
                data = node[...]
            else:
                data = indexing.LazilyIndexedArray(StoredArray(files, path, node.shape, node.dtype))
            variables[path] = xr.Variable(dims, data, described)
    return variables, attributes


def _path(*parts: str) -> str:
    """Return the path of ``parts`` in a file, as names of variables and of attributes have it."""
    return "/".join(parts).strip("/")


def _nodes(path: str, group: h5py.Group) -> Iterator[tuple[str, Node]]:
    """Yield the ``group`` at a ``path``, its datasets, and then each group in it with its own contents, by their paths.

    Soft links are left out: they lead to coordinates of other groups.
    """
    yield path, group
    groups = {}
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        member = group[name]
        if isinstance(member, h5py.Dataset):
            yield _path(path, name), member
        elif isinstance(member, h5py.Group):
            groups[_path(path, name)] = member

    for inner_path, inner in groups.items():
        yield from _nodes(inner_path, inner)


def _stored_attributes(node: Node) -> dict[str, Any]:
    """Return the attributes of a group or dataset, without the lists of scales and of what a scale has."""
    lists = {"REFERENCE_LIST", "DIMENSION_LIST"}
    return {name: _attribute(node.attrs[name]) for name in node.attrs if name not in lists}


def _dimensions(path: str, dataset: h5py.Dataset, stored: Mapping[str, Any], paths: Mapping[Node, str]) -> list[str]:
    """Return the names of the dimensions of a ``dataset`` at a ``path``, with ``stored`` attributes.

    The dimension of an axis is named by the path of the scale that is attached to it, which ``paths`` has; a scale has
    the dimension of its own path. An axis without a scale is a dimension that no other dataset has.
    """
    if dataset.ndim == 1 and stored.get("CLASS") == "DIMENSION_SCALE":
        return [path]

    dims = []
    for axis, scales in enumerate(dataset.dims):
        if len(scales):
            dims.append(paths[scales[0]])
        else:
            dims.append(_path(path, f"axis_{axis}"))
    return dims


def _attribute(value: Any) -> Any:
    """Return the ``value`` of an attribute: texts as str, several in a list; an array of one number as that number."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "surrogateescape")
    if isinstance(value, h5py.Empty):
        return np.array([], value.dtype)
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.kind in "SO":
        value = [_attribute(text) for text in value.flat]
    if len(value) == 1:
        return value[0]
    return value
