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
from vipetsc.io.errors import ResultFileError, UnreadableFileError
from vipetsc.register import PartError
from vipetsc.wording import shortened, system_number, system_reason

# xarray loads pandas, which takes as long as all else that a command needs before it begins: functions import it.
if TYPE_CHECKING:
    import xarray as xr
    from xarray.backends import CachingFileManager

MAY_BE_EMPTY = ("site", "episode")  # dimensions of runs without sites, or without contact
Variables: TypeAlias = "dict[str, xr.Variable]"
"""Variables of a dataset by name."""
Node: TypeAlias = "h5py.h5g.GroupID | h5py.h5d.DatasetID"

# Attributes by which HDF5 and netCDF-4 describe dimensions. Readers do not see them as attributes of a variable.
DIMENSION_ATTRIBUTES = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "DIMENSION_LABELS", "coordinates"}
DIMENSION_ATTRIBUTES |= {"_Netcdf4Dimid", "_Netcdf4Coordinates", "_nc3_strict", "_NCProperties"}
# The attribute NAME of a dimension without a coordinate begins so.
NO_COORDINATE = b"This is a netCDF dimension but not a netCDF variable"

# An attribute that is a text: its type in memory, its type in the file, and its space.
TEXT = h5py.string_dtype()
STORED_TEXT = h5py.h5t.py_create(TEXT, logical=True)
ONE_VALUE = h5py.h5s.create_simple(())


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
    # HDF5 only makes the file in memory, and Python writes its bytes: where the disk is full, HDF5 would crash later.
    with h5py.File(Path(path).name, "w", driver="core", backing_store=False) as file:
        put_dataset(file, data)
        file.flush()
        image = file.id.get_file_image()
    with atomic_write(Path(path)) as aside:
        aside.write_bytes(image)


def put_dataset(file: h5py.File, data: xr.Dataset, write: bool = True) -> None:
    """Add the variables and attributes of ``data`` to ``file``; an attribute that is a dict or a list becomes JSON.

    All ranks that have the file open must call it with the same data; one of them has to ``write`` the values. Raises
    ValueError if a dimension has no coordinate, or the name of another one further up.
    """
    _check_dimensions(data)
    # Coordinates come first, because variables are attached to their scales.
    indexes = data.indexes
    variables = data.variables
    for name in [*indexes, *(name for name in variables if name not in indexes)]:
        item = variables[name]
        values = item.values
        dtype = values.dtype
        is_text = dtype.kind in "UO"
        # HDF5 has no type for numpy's text of fixed width, and h5py takes texts of any length as objects.
        if is_text:
            values = values.astype(object)
            dtype = TEXT
        dataset = _add_dataset(file, name, item.dims, values.shape, dtype, item.attrs)
        if not write or not values.size:
            continue

        if is_text:
            h5py.Dataset(dataset)[...] = values
        else:
            dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, np.ascontiguousarray(values))

    for path, value in data.attrs.items():
        group, _, key = str(path).rpartition("/")
        node = file.require_group(group or "/").id
        # HDF5 has attributes that are a number, a text or an array of either.
        if isinstance(value, dict | list):
            value = json.dumps(value)
        _put_attribute(node, key, value)


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
    return h5py.Dataset(_add_dataset(file, name, dims, shape, dtype, attributes))


def _add_dataset(
    file: h5py.File, name: Hashable, dims: Sequence[Hashable], shape: Sequence[int], dtype: Any, attributes: Any
) -> h5py.h5d.DatasetID:
    """Add an empty dataset as ``add_variable`` does; return it as an object of h5py's low level.

    The high level makes the same file in four times the time: it asks HDF5 for much of each dataset that it opens.
    """
    path = str(name)
    group, _, own_name = path.rpartition("/")
    nodes = file.id
    if path.encode() in nodes:
        # A soft link to a coordinate of that name outside the group has its place.
        del file[path]
    if group and group.encode() not in nodes:
        file.create_group(group)

    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    # Two files of the same contents have the same bytes, whenever they are written.
    properties.set_obj_track_times(False)
    stored_type = h5py.h5t.py_create(np.dtype(dtype), logical=True)
    space = h5py.h5s.create_simple(tuple(shape))
    dataset = h5py.h5d.create(nodes, path.encode(), stored_type, space, properties)

    if tuple(dims) == (name,):
        h5py.h5ds.set_scale(dataset, own_name.encode())
    else:
        for axis, dim in enumerate(map(str, dims)):
            if dim.encode() not in nodes:
                raise ValueError(f"{name}: its dimension {dim} has no coordinate")
            h5py.h5ds.attach_scale(dataset, h5py.h5d.open(nodes, dim.encode()), axis)
            link = _path(group, dim.rpartition("/")[2])
            if link.encode() not in nodes:
                file[link] = h5py.SoftLink(f"/{dim}")

    for key, value in attributes.items():
        _put_attribute(dataset, key, value)
    return dataset


def _put_attribute(node: Node, key: str, value: Any) -> None:
    """Give a group or a dataset an attribute, which replaces one of the same name."""
    if isinstance(value, str) and not h5py.h5a.exists(node, key.encode()):
        attribute = h5py.h5a.create(node, key.encode(), STORED_TEXT, ONE_VALUE)
        attribute.write(np.array(value, dtype=TEXT))
        return

    # Other values are few. The high level finds a type for them.
    holder: h5py.Group | h5py.Dataset
    if isinstance(node, h5py.h5g.GroupID):
        holder = h5py.Group(node)
    else:
        holder = h5py.Dataset(node)
    holder.attrs[key] = value


def open_netcdf(path: str | Path, kind: str, needs: Sequence[str] = ()) -> xr.Dataset:
    """Open a file as a flat dataset, a context manager; values are read when they are used.

    Messages call the file a ``kind``, as "run" or "branch"; ``needs`` are the variables (by path), groups and root
    attributes that a file of this kind must have. Raises UnreadableFileError, an OSError, if the file cannot be opened
    as HDF5, ResultFileError, a ValueError, if it is not of this kind.
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
    reason = system_reason(error)
    if "unable to lock" in str(error):
        reason = "another program has it open for writing"
    if isinstance(error, KeyError):
        reason = "it lacks the coordinate of a dimension of its variables"
    return UnreadableFileError(system_number(error), f"{path} cannot be opened as a {kind}: {reason}")


@contextmanager
def naming_spoilt(opened: Callable[[], Iterable[xr.Dataset]]) -> Iterator[None]:
    """Name what is not finite in results, or empty, where an error in the block may come from it.

    ``opened`` returns the results that the block has opened. Raises ResultFileError then; errors about files, names of
    figures and users' modules stay as they are, and so does any other where all results are finite.
    """
    try:
        yield
    except (OSError, KeyError, ResultFileError, PartError):
        raise
    except Exception as error:
        reasons = [text for data in opened() for text in _spoilt(data)]
        if not reasons:
            raise
        remedy = "compute the results again"
        raise ResultFileError(f"{'; '.join(reasons)} ({type(error).__name__}: {error}); {remedy}") from error


def _spoilt(data: xr.Dataset) -> list[str]:
    """Sentences on variables of ``data`` that hold numbers that are not finite, and on dimensions without entries."""
    file = data.encoding.get("source", "the file")
    floats = [(name, values) for name, values in data.variables.items() if values.dtype.kind in "fc"]
    infinite = [str(name) for name, values in floats if not np.isfinite(values).all()]
    empty = [str(name) for name, size in data.sizes.items() if size == 0 and name not in MAY_BE_EMPTY]
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
    """The variables of all groups of the file that ``files`` opens, and the groups' attributes, by their paths."""
    import xarray as xr
    from xarray.core import indexing

    from vipetsc.io.stored_array import StoredArray

    variables: Variables = {}
    attributes: dict[str, Any] = {}
    with files.acquire_context() as file:
        nodes = dict(_nodes("", h5py.h5g.open(file.id, b"/")))
        # Objects are recognised by their addresses: for the name of an object HDF5 would search the whole file.
        paths = {h5py.h5o.get_info(node).addr: path for path, node in nodes.items()}

        for path, node in nodes.items():
            stored = _stored_attributes(node)
            described = {key: _attribute(value) for key, value in stored.items() if key not in DIMENSION_ATTRIBUTES}
            if isinstance(node, h5py.h5g.GroupID):
                attributes |= {_path(path, key): value for key, value in described.items()}
                continue
            if bytes(stored.get("NAME", b"")).startswith(NO_COORDINATE):
                continue

            dims = _dimensions(file, path, node, stored, paths)
            # Texts are read at once: they are few, and the type of numpy's array depends on the longest. So are
            # coordinates, of which xarray makes indexes.
            if h5py.check_string_dtype(node.dtype):
                data = h5py.Dataset(node).asstr()[...].astype(str)
            elif dims == [path]:
                data = h5py.Dataset(node)[...]
            else:
                data = indexing.LazilyIndexedArray(StoredArray(files, path, node.shape, node.dtype))
            variables[path] = xr.Variable(dims, data, described)
    return variables, attributes


def _path(*parts: str) -> str:
    """The path of ``parts`` in a file, as names of variables and of attributes have it."""
    return "/".join(parts).strip("/")


def _nodes(path: str, group: h5py.h5g.GroupID) -> Iterator[tuple[str, Node]]:
    """The ``group`` at a ``path``, its datasets, and then each group in it with its own contents, by their paths.

    Soft links are left out: they lead to coordinates of other groups. Nodes are of h5py's low level: its groups and
    datasets take twice the time.
    """
    yield path, group
    groups = {}
    for name in group:
        if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
            continue
        member = h5py.h5o.open(group, name)
        member_path = _path(path, name.decode("utf-8", "surrogateescape"))
        if isinstance(member, h5py.h5d.DatasetID):
            yield member_path, member
        elif isinstance(member, h5py.h5g.GroupID):
            groups[member_path] = member

    for inner_path, inner in groups.items():
        yield from _nodes(inner_path, inner)


def _stored_attributes(node: Node) -> dict[str, Any]:
    """The attributes of a group or a dataset with texts as bytes, without the list of the datasets that a scale has."""
    stored: dict[str, Any] = {}
    for index in range(h5py.h5a.get_num_attrs(node)):
        attribute = h5py.h5a.open(node, index=index)
        name = attribute.name.decode("utf-8", "surrogateescape")
        if name == "REFERENCE_LIST":
            continue

        dtype = attribute.dtype
        if attribute.get_space().get_simple_extent_type() == h5py.h5s.NULL:
            stored[name] = h5py.Empty(dtype)
            continue
        values = np.empty(attribute.shape, dtype)
        # The type is named because numpy counts a type that is itself an array among the axes.
        attribute.read(values, h5py.h5t.py_create(dtype))
        stored[name] = values[()]
    return stored


def _dimensions(
    file: h5py.File, path: str, dataset: h5py.h5d.DatasetID, stored: Mapping[str, Any], paths: Mapping[int, str]
) -> list[str]:
    """The names of the dimensions of a ``dataset`` at a ``path``, with ``stored`` attributes.

    The dimension of an axis is named by the path of the scale that is attached to it, which ``paths`` has by the
    address; a scale has the dimension of its own path. An axis without a scale is a dimension that no other dataset
    has.
    """
    if dataset.rank == 1 and stored.get("CLASS") == b"DIMENSION_SCALE":
        return [path]

    dims = []
    for axis, scales in enumerate(stored.get("DIMENSION_LIST", [[]] * dataset.rank)):
        if len(scales):
            scale = h5py.h5r.dereference(scales[0], file.id)
            dims.append(paths[h5py.h5o.get_info(scale).addr])
        else:
            dims.append(_path(path, f"axis_{axis}"))
    return dims


def _attribute(value: Any) -> Any:
    """The ``value`` of an attribute: texts as str, several in a list; an array of one number as that number."""
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
