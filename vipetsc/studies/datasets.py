"""Datasets with named dimensions, units and descriptions, as netCDF-4 has them."""

from __future__ import annotations

import h5py


def put(group: h5py.Group, name: str, values: object, units: str, long_name: str, *dims: str) -> h5py.Dataset:
    """Write ``values`` over the named dimensions; without any, an array becomes a dimension scale itself."""
    data = group.create_dataset(name, data=values)
    data.attrs["units"], data.attrs["long_name"] = units, long_name
    if not dims and data.ndim:
        data.make_scale(name)
    for axis, dim in enumerate(dims):
        data.dims[axis].attach_scale(group[dim] if dim in group else group.file[dim])
    return data
