"""Export of results to other programs: XDMF for ParaView, which reads ``run.h5`` itself, and curves as CSV."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
import xarray as xr

from vipetsc.io.atomic import atomic_write, write_text
from vipetsc.io.branch_kinds import RESPONSES
from vipetsc.io.chunks import FORCES, MOTION
from vipetsc.io.read import field_time, open_results, open_run
from vipetsc.wording import with_unit

MOST_FRAMES = 5000  # of a run with more samples, every n-th; a frame takes about 1 kB of the text
MOST_ROWS = 1_000_000  # of a table, as many as spreadsheets read
MOST_NUMBERS = 20_000_000  # of a table with a column for each point or site: 400 MB of text
ANALYSIS = "analysis.h5"
FIELDS = "displacement", "velocity"
# Of the designs of a search, by the dimension whose labels say what each column is.
OF_DESIGNS = {"parameter": "variable", "value": "objective", "constrained": "constraint"}
# Of frequency responses, the dimensions whose labels name the columns of a table.
OF_RESPONSES = {"way", "site", "location", "pair", "wall"}
HEAD = '<Xdmf Version="3.0"><Domain><Grid Name="run" GridType="Collection" CollectionType="Temporal">\n'
TAIL = "</Grid></Domain></Xdmf>\n"


def write_xdmf(folder: Path) -> Path | None:
    """Write ``run.xdmf`` next to ``run.h5``; None for a run without fields. Raises as ``open_run``.

    A regular mesh of nodes (cell, mass), and at every frame the fields as hyperslabs of the datasets in ``run.h5``.
    """
    with open_run(folder / "run.h5") as run:
        units = {name: run[name].attrs["units"] for name in FIELDS if name in run}
        if not units:
            return None
        times = field_time(run)
        cells = run["cell"].values
        shape = run[next(iter(units))].shape

    frame = _frame(cells, shape, units)
    rows = range(0, shape[0], -(-shape[0] // MOST_FRAMES))
    frames = [frame.format(row=row, time=float(times[row])) for row in rows]
    write_text(folder / "run.xdmf", HEAD + "".join(frames) + TAIL)
    return folder / "run.xdmf"


def _frame(cells: np.ndarray, shape: tuple[int, ...], units: dict[str, str]) -> str:
    """The grid of a frame, with ``{row}`` and ``{time}`` to be filled in, of fields (t, cell, dof) by their units."""
    mesh = _words(shape[1:])
    grid = Xml.Element("Grid", Name="sample {row}", GridType="Uniform")
    _child(grid, "Time", Value="{time!r}")
    _child(grid, "Topology", TopologyType="2DCoRectMesh", Dimensions=mesh)
    geometry = _child(grid, "Geometry", GeometryType="ORIGIN_DXDY")
    # Cells along the slow axis, as the datasets have them; a single cell has no spacing of its own.
    spacing = 1
    if len(cells) > 1:
        spacing = cells[1] - cells[0]
    _child(geometry, "DataItem", _words((cells[0], 1)), Dimensions="2", Format="XML")
    _child(geometry, "DataItem", _words((spacing, 1)), Dimensions="2", Format="XML")

    for name, unit in units.items():
        node = _child(grid, "Attribute", Name=f"{name} ({unit})", AttributeType="Scalar", Center="Node")
        slab = _child(node, "DataItem", ItemType="HyperSlab", Dimensions=mesh)
        start_stride_count = f"{{row}} 0 0 1 1 1 1 {mesh}"
        _child(slab, "DataItem", start_stride_count, Dimensions="3 3", Format="XML")
        about = {"Format": "HDF", "NumberType": "Float", "Precision": "8", "Dimensions": _words(shape)}
        _child(slab, "DataItem", f"run.h5:/{name}", **about)
    Xml.indent(grid, " ")
    return Xml.tostring(grid, "unicode") + "\n"


def has_xdmf(folder: Path) -> bool:
    """Whether ``run.xdmf`` exists and is not older than ``run.h5``."""
    mesh = folder / "run.xdmf"
    run = folder / "run.h5"
    return mesh.exists() and mesh.stat().st_mtime_ns >= run.stat().st_mtime_ns


def _child(parent: Xml.Element, tag: str, text: str | None = None, **attributes: str) -> Xml.Element:
    """Add an element to ``parent``, and return it."""
    child = Xml.SubElement(parent, tag, attributes)
    child.text = text
    return child


def _words(values: Iterable[float]) -> str:
    """Numbers in all digits, separated by blanks."""
    return " ".join(f"{value:.17g}" for value in values)


def write_curves(path: Path) -> list[Path]:
    """Write the curves of the results in ``path`` as CSV files to ``curves/`` in their folder.

    Variables over the same dimensions are one table, with a row a point, their coordinates first, units in the head.
    That of the designs of a search has a column for each variable, objective and constraint, that of a frequency
    response one for each named mass, contact and wall.
    Of a run with ``analysis.h5`` in the same folder there is a table of its numbers, ``analysis-measures.csv``, and
    where they were recorded ``run-points.csv`` and ``run-forces.csv``, with a column for each point and site. Fields
    and maps, over other dimensions than the axes of a sweep, are left out. Raises as ``open_results``.
    """
    written = []
    with open_results(path) as data:
        source = Path(data.encoding.get("source", path / "ensemble.h5"))
        # Of a sweep: a status of each member.
        axes: tuple[Any, ...] = ()
        if "status" in data:
            axes = data["status"].dims
        groups: dict[tuple[str, ...], list[str]] = {}
        for name, item in data.data_vars.items():
            if len(item.dims) == 1 or (axes and item.dims == axes):
                groups.setdefault(tuple(map(str, item.dims)), []).append(str(name))

        for dims, names in groups.items():
            if np.prod([data.sizes[dim] for dim in dims]) > MOST_ROWS:
                continue
            table = data[names].assign(_columns_of_designs(data, dims) | _columns_of_responses(data, dims))
            # CSV has no room for coordinates over other dimensions, such as the cells of sites.
            foreign = [name for name, item in table.coords.items() if not set(item.dims) <= set(dims)]
            # The dimensions name the file: variables over other ones are another table.
            over = "-".join(dims)
            if dims == axes:
                over = "members"
            stem = f"{source.stem}-{over}".replace("/", "-")
            path_of_table = source.parent / "curves" / f"{stem}.csv"
            written.append(_write_table(path_of_table, table.drop_vars(foreign)))
        written += _write_wide(data, source)

    # The numbers of a run are in another file of its folder.
    measured = source.with_name(ANALYSIS)
    if source.name in ("run.h5", ANALYSIS) and measured.exists():
        with open_results(measured) as analysis:
            numbers = _numbers(analysis)
        if numbers["measure"]:
            written.append(_write_columns(measured.parent / "curves" / f"{measured.stem}-measures.csv", numbers))
    return written


def _columns_of_designs(data: xr.Dataset, dims: tuple[str, ...]) -> dict[str, xr.DataArray]:
    """Variables, objectives and constraints over the designs of a search, by their labels; none of other ``dims``."""
    columns = {}
    for name, label in OF_DESIGNS.items():
        if name not in data or data[name].dims != (*dims, label):
            continue
        units = ["1"] * data.sizes[label]
        if label == "variable":
            units = data["unit"].values.tolist()
        for text, unit, values in zip(data[label].values, units, data[name].values.T, strict=True):
            columns[str(text)] = xr.DataArray(values, dims=dims, attrs={"units": unit})
    return columns


def _columns_of_responses(data: xr.Dataset, dims: tuple[str, ...]) -> dict[str, xr.DataArray]:
    """Variables of a frequency response over its points by mass, contact or wall; none of other results or ``dims``."""
    columns: dict[str, xr.DataArray] = {}
    if dims != ("point",) or data.attrs.get("branch_kind") != RESPONSES:
        return columns
    for name, item in data.data_vars.items():
        if len(item.dims) == 2 and item.dims[1] in OF_RESPONSES:
            for label, values in zip(data[item.dims[1]].values, item.values.T, strict=True):
                columns[f"{name}/{label}"] = xr.DataArray(values, dims=dims, attrs={"units": item.attrs["units"]})
    return columns


def _write_wide(run: xr.Dataset, source: Path) -> list[Path]:
    """Write the motion of points and the forces of sites of a ``run`` over time, with a column for each of these."""
    columns: dict[str, dict[str, np.ndarray]] = {"points": {}, "forces": {}}
    for name in MOTION:
        if name in run:
            unit = run[name].attrs["units"]
            for point, values in zip(run["point"].values, run[name].values.T, strict=True):
                columns["points"][f"{point} {name.removeprefix('points/')} ({unit})"] = values
    if FORCES in run:
        for site, values in zip(run["site"].values, run[FORCES].values.T, strict=True):
            columns["forces"][f"force of site {site} (N)"] = values

    written = []
    for kind, table in columns.items():
        if table and len(table) * run.sizes["time"] <= MOST_NUMBERS:
            path = source.parent / "curves" / f"{source.stem}-{kind}.csv"
            written.append(_write_columns(path, {"time (s)": run["time"].values} | table))
    return written


def _numbers(analysis: xr.Dataset) -> dict[str, list[Any]]:
    """Columns of a table of all numbers in an ``analysis``, a row each; those of parts of the frequency axis too."""
    rows = []
    for name, item in analysis.data_vars.items():
        unit = item.attrs.get("units", "1")
        text = item.attrs.get("long_name", "")
        if not item.dims:
            rows.append((str(name), item.item(), unit, text))
        elif "parts" in item.attrs and len(item.dims) == 1:
            parts = zip(np.atleast_1d(item.attrs["parts"]), item.values.tolist(), strict=True)
            rows += [(f"{name} {part}", value, unit, text) for part, value in parts]
    names = ("measure", "value", "unit", "text")
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def _write_table(path: Path, table: xr.Dataset) -> Path:
    """Write a dataset of variables over the same dimensions as CSV."""
    frame = table.to_dataframe().reset_index()
    heads = []
    for name in frame.columns:
        unit = "1"
        if name in table.variables:
            unit = table[name].attrs.get("units", "1")
        heads.append(with_unit(name, unit))
    frame.columns = heads
    return _write_frame(path, frame)


def _write_columns(path: Path, columns: Mapping[str, Any]) -> Path:
    """Write a table of ``columns`` of one length, by what stands at their heads, as CSV."""
    rows = xr.Dataset({head: ("row", np.asarray(values)) for head, values in columns.items()})
    return _write_frame(path, rows.to_dataframe())


def _write_frame(path: Path, frame: Any) -> Path:
    """Write a pandas ``frame`` as CSV."""
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as aside:
        # The shortest text that reads back as the same number.
        frame.to_csv(aside, index=False)
    return path
