"""The layout of HDF5 files: files are read back as they were written, by xarray and by h5py."""

import json

import h5py
import numpy as np
import pytest
import xarray as xr

from vipetsc.io.errors import ResultFileError, UnreadableFileError
from vipetsc.io.netcdf import naming_spoilt, open_netcdf, variable, write_netcdf


def measured() -> xr.Dataset:
    """Return a dataset with groups that have dimensions of their own, texts, scalars and empty variables."""
    variables = {
        "time": variable("time", [0.0, 0.5, 1.0], "s", "time"),
        "cell": variable("cell", [3, 7], "1", "cell, counted from 1"),
        # A lattice without sites has dimensions of length zero, a special case in HDF5.
        "site": variable("site", np.zeros(0, int), "1", "contact site"),
        "velocity": variable(("time", "cell"), np.arange(6.0).reshape(3, 2), "m/s", "velocity"),
        "sites/cell": variable("site", np.zeros(0, int), "1", "cell of the site"),
        "bands/part": variable("bands/part", np.array([1, 2, 3]), "1", "part"),
        "bands/energy": variable(("bands/part", "time"), np.eye(3), "J", "energy", parts=["A", "gap", "B"]),
        # Its link in the group to the coordinate of the root makes room for the next variable.
        "bands/mass": variable("cell", [4e-3, 2e-3], "kg", "mass"),
        # In xarray's DataTree a group inherits the root's coordinate of that name in its place.
        "bands/cell": variable("bands/part", np.array([7, 7, 3], np.int8), "1", "not the coordinate of the root"),
        "coarse/step": variable("coarse/step", [0.0, 1.0], "s", "a time of the group's own"),
        "coarse/total": variable("coarse/step", [3.0, 4.0], "J", "kinetic energy"),
        "law": variable("law", ["hertz", "bilinear"], "1", "contact law"),
        "ibtet": variable((), 0.25, "1", "transfer", start=0.5),
    }
    attributes = {"case": "name = 'x'", "statistics": {"steps": 3}, "complete": True, "bands/start": 0.5}
    return xr.Dataset(variables, attrs=attributes)


def test_what_is_written_is_read_back(tmp_path):
    """Values, dimensions, types and attributes of every variable survive a file, and coordinates select in it."""
    path = tmp_path / "a.h5"
    write_netcdf(path, measured())

    with open_netcdf(path, "run", ("velocity", "bands", "bands/energy", "case")) as data:
        assert data.variables.keys() == measured().variables.keys()
        for name, item in measured().variables.items():
            np.testing.assert_array_equal(data[name].values, item.values, err_msg=name)
            assert data[name].dims == item.dims, name
            assert data[name].attrs.keys() == item.attrs.keys(), name
        assert data["bands/cell"].dtype == np.int8

        assert json.loads(data.attrs["statistics"]) == {"steps": 3}
        assert data.attrs["bands/start"] == 0.5

        # The group's own coordinate selects, although the root has one of the same name.
        assert data["coarse/total"].sel({"coarse/step": 1.0}).item() == 4.0
        assert data["velocity"].sel(cell=7, time=0.5).item() == 3.0
        assert data["bands/energy"].sel({"bands/part": 2}).values.tolist() == [0, 1, 0]


def test_the_file_is_netcdf_4_for_other_tools(tmp_path):
    """Dimension scales, texts and attributes of groups are where h5py and xarray look for them in netCDF-4."""
    path = tmp_path / "a.h5"
    write_netcdf(path, measured())

    with h5py.File(path) as file:
        assert file["velocity"].dims[1][0] == file["cell"]
        assert file["bands/energy"].dims[0][0] == file["bands/part"]
        assert file["bands/energy"].dims[1][0] == file["time"]
        assert file["law"].asstr()[...].tolist() == ["hertz", "bilinear"]
        assert file["bands"].attrs["start"] == 0.5

        # Programs that open a group alone find the coordinates of the root in it.
        assert file["bands"].get("time", getlink=True).path == "/time"
        # Files of the same contents have the same bytes at any time.
        assert h5py.h5g.get_objinfo(file.id, b"velocity").mtime == 0

    with xr.open_dataset(path, engine="h5netcdf", group="bands") as bands:
        assert bands["energy"].dims == ("part", "time")
        assert bands["energy"].attrs["units"] == "J"


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    """A dataset without a needed coordinate is refused; the earlier file keeps its bytes, and no other file is left."""
    path = tmp_path / "a.h5"
    write_netcdf(path, measured())
    before = path.read_bytes()

    with pytest.raises(ValueError, match="velocity: its dimension cell has no coordinate"):
        write_netcdf(path, measured().drop_vars("cell"))

    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "key", [(1, 0), (slice(None, None, -1), 1), ([2, 0, 2], slice(None)), ([2, 0], [1, 0, 0]), (-1, slice(1, 0))]
)
def test_fields_are_read_where_they_are_indexed(tmp_path, key):
    """Repeated positions in any order, backward steps and empty ranges, which HDF5 does not support, can be read."""
    write_netcdf(tmp_path / "a.h5", measured())
    with open_netcdf(tmp_path / "a.h5", "run") as data:
        np.testing.assert_array_equal(data["velocity"][key].values, measured()["velocity"][key].values)


def test_files_of_xarray_itself_are_read(tmp_path):
    """A file that xarray has written is read: dimensions without coordinates, texts, attributes of every type."""
    attributes = {"whole": 3, "several": [1.5, 2.5], "words": ["a", "b"], "word": "µm"}
    written = xr.Dataset({"field": (("row", "time"), np.arange(6.0).reshape(2, 3), attributes)}, {"time": [1, 2, 3]})
    written["field"].encoding["_FillValue"] = None
    written["label"] = ("row", ["first", "second"])
    written.to_netcdf(tmp_path / "a.nc", format="NETCDF4", engine="h5netcdf")

    with open_netcdf(tmp_path / "a.nc", "state") as data:
        assert data.variables.keys() == {"field", "time", "label"}
        assert data["field"].dims == ("row", "time")
        assert data["label"].values.tolist() == ["first", "second"]
        assert {name: np.asarray(value).tolist() for name, value in data["field"].attrs.items()} == attributes


def test_a_dimension_of_two_lengths_is_refused_with_the_file(tmp_path):
    """A dataset that is shorter than its scale, as netCDF-4 may have it, is an error that names the file."""
    with h5py.File(tmp_path / "uneven.h5", "w") as file:
        file["time"] = np.arange(4.0)
        file["time"].make_scale()
        file["value"] = np.arange(3.0)
        file["value"].dims[0].attach_scale(file["time"])
    with pytest.raises(UnreadableFileError, match=r"uneven\.h5 cannot be opened as a run: conflicting sizes"):
        open_netcdf(tmp_path / "uneven.h5", "run")


def test_files_of_another_kind_are_refused(tmp_path):
    """A missing file, one that is no HDF5 and one of another program are refused with what they lack."""
    with pytest.raises(OSError, match="missing"):
        open_netcdf(tmp_path / "missing.h5", "run")

    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(OSError, match=r"text\.h5"):
        open_netcdf(tmp_path / "text.h5", "run")

    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["values"] = np.zeros((2, 2))
    with pytest.raises(ValueError, match=r"foreign\.h5 is not a run of vipetsc: it lacks time, energy/kinetic, case"):
        open_netcdf(tmp_path / "foreign.h5", "run", ("time", "energy/kinetic", "values", "case"))


@pytest.mark.parametrize(("below", "above"), [("g/cell", "cell"), ("g/h/part", "g/part"), ("g/h/cell", "cell")])
def test_a_file_is_one_that_xarray_opens_as_a_tree(tmp_path, below, above):
    """A tree of groups inherits dimensions: a dimension of the name of one above it is refused when it is written."""
    path = tmp_path / "file.h5"
    write_netcdf(path, measured())
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        assert tree["bands"]["energy"].dims == ("part", "time")

    data = xr.Dataset({name: variable(name, np.arange(float(len(name))), "1", "number") for name in (below, above)})
    with pytest.raises(ValueError, match=f"{below} has the name of the dimension {above}"):
        write_netcdf(path, data)
    with xr.open_datatree(path, engine="h5netcdf"):
        pass


@pytest.mark.parametrize(
    ("error", "is_spoilt", "is_blamed"),
    [
        (ValueError, False, False),
        (np.linalg.LinAlgError, True, True),
        (IndexError, True, True),
        (ZeroDivisionError, True, True),
        (MemoryError, True, False),
        (RuntimeError, True, False),
        (OSError, True, False),
    ],
)
def test_errors_of_numbers_are_blamed_on_numbers_that_are_no_longer_finite(tmp_path, error, is_spoilt, is_blamed):
    """Numbers that were missing by right when they were written, as the end of a gap, are no cause.

    Nor are dimensions that are empty in runs without contact.
    """
    path = tmp_path / "a.h5"
    edges = variable("edge", [0.0, 1.0, np.inf], "rad/s", "edges")
    clusters = variable("bands/cluster", np.zeros(0, int), "1", "cluster")
    data = xr.Dataset({"edge": variable("edge", [1, 2, 3], "1", "edge"), "edges": edges, "bands/cluster": clusters})
    write_netcdf(path, data)
    if is_spoilt:
        with h5py.File(path, "r+") as file:
            file["edges"][1] = np.nan

    expected = ResultFileError if is_blamed else error
    with open_netcdf(path, "run") as data, pytest.raises(expected) as raised, naming_spoilt(lambda: [data]):
        raise error("of a picture")
    assert ("a.h5 holds numbers that are not finite in edges" in str(raised.value)) == is_blamed
