"""Export of results to other programs: XDMF for ParaView, which reads ``run.h5`` itself, and curves as CSV."""

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
import xarray as xr

from vipetsc.io.atomic import atomic_write, write_text
from vipetsc.io.branch_kinds import RESPONSES
from vipetsc.io.chunks import FORCES, MOTION
from vipetsc.io.impacts import impacts
from vipetsc.io.read import field_time, open_results, open_run
from vipetsc.lattice.plane import KINDS
from vipetsc.wording import with_unit

# Samples that run.xdmf lists; of a run with more, every n-th. One takes about 1 kB, so that the text has 5 MB at most.
MOST_FRAMES = 5000
MOST_ROWS = 1_000_000  # rows of a table: spreadsheets read no more
MOST_NUMBERS = 20_000_000  # numbers in a table with a column for each point or site: 400 MB of text
ANALYSIS = "analysis.h5"
FIELDS = "displacement", "velocity"
# Variables of a search over (design, label), each with the dimension of its labels, which name the columns of a table.
DESIGN_LABELS = {"parameter": "variable", "value": "objective", "constrained": "constraint"}
# Second dimensions that variables of a frequency response may have. Their labels name the columns of its table.
RESPONSE_LABELS = {"way", "site", "location", "pair", "wall"}
Vectors = tuple[tuple[float, ...], tuple[float, ...]]
SQUARE: Vectors = ((1.0, 0.0), (0.0, 1.0))
HEAD = '<Xdmf Version="3.0"><Domain>\n'
GRID = '<Grid Name="run" GridType="Collection" CollectionType="Temporal">\n'
TAIL = "</Grid></Domain></Xdmf>\n"


def write_xdmf(folder: Path) -> Path | None:
    """Write ``run.xdmf`` next to ``run.h5`` in ``folder``, and return its path; None for a run without fields.

    The text describes a regular mesh of nodes (cell, mass), of a strip of the plane (cell, row) with a field for each
    mass, and for each frame says which hyperslabs of the datasets in ``run.h5`` are the fields. Raises OSError or
    ValueError as ``open_run``, OSError if the text cannot be written.
    """
    with open_run(folder / "run.h5") as run:
        units = {name: run[name].attrs["units"] for name in FIELDS if name in run}
        if not units:
            return None
        times = field_time(run)
        cells = run["cell"].values
        shape = run[next(iter(units))].shape
        across = shape[2]
        vectors = SQUARE
        if "row" in run.coords:
            across = int(run["row"][-1])
            vectors = _vectors(tomllib.loads(run.attrs["case"])["lattice"]["cell"]["from_strip"])

    # Nodes that lie askew are listed, once for all frames. The others are a regular mesh, which each frame describes.
    mesh = _mesh(cells, across, vectors)
    head = HEAD
    if vectors != SQUARE:
        head += "".join(Xml.tostring(part, "unicode") + "\n" for part in mesh)
        mesh = [Xml.Element(part.tag, Reference=f"/Xdmf/Domain/{part.tag}[1]") for part in mesh]
    # The XML is made once, since frames differ in two numbers only.
    frame = _frame(shape, units, across, mesh)
    rows = range(0, shape[0], -(-shape[0] // MOST_FRAMES))
    frames = [frame.format(row=row, time=float(times[row])) for row in rows]
    write_text(folder / "run.xdmf", head + GRID + "".join(frames) + TAIL)
    return folder / "run.xdmf"


def _vectors(strip: Mapping[str, Any]) -> Vectors:
    """Return the vectors from a cell to the next one along and across, as the section of a ``strip`` has them."""
    if strip["kind"] != "cell":
        return KINDS[strip["kind"]](1.0, 1.0, 1.0).vectors
    along, across = strip.get("vectors") or SQUARE
    return tuple(along), tuple(across)


def _mesh(cells: np.ndarray, across: int, vectors: Vectors) -> list[Xml.Element]:
    """Return topology and geometry of the nodes of ``cells`` (i,), each with ``across`` ones.

    Node j of cell i lies at i a_1 + j a_2, with the ``vectors`` a_1 and a_2.
    """
    # Cells are the slower axis, as in the datasets, and come first.
    dimensions = _words((len(cells), across))
    if vectors == SQUARE:
        topology = Xml.Element("Topology", TopologyType="2DCoRectMesh", Dimensions=dimensions)
        geometry = Xml.Element("Geometry", GeometryType="ORIGIN_DXDY")
        # A single cell has no spacing of its own.
        spacing = cells[1] - cells[0] if len(cells) > 1 else 1
        _child(geometry, "DataItem", _words((cells[0], 1)), Dimensions="2", Format="XML")
        _child(geometry, "DataItem", _words((spacing, 1)), Dimensions="2", Format="XML")
        return [topology, geometry]

    topology = Xml.Element("Topology", TopologyType="2DSMesh", Dimensions=dimensions)
    geometry = Xml.Element("Geometry", GeometryType="XY")
    numbers = np.stack(np.meshgrid(cells, np.arange(1, across + 1), indexing="ij"), axis=-1)
    positions = _words((numbers @ np.array(vectors)).ravel().tolist())
    _child(geometry, "DataItem", positions, Dimensions=f"{dimensions} 2", Format="XML")
    return [topology, geometry]


def _frame(shape: tuple[int, ...], units: dict[str, str], across: int, mesh: list[Xml.Element]) -> str:
    """Return the text of a frame's grid, in which ``{row}`` and ``{time}`` are to be filled in.

    ``shape`` is that of the fields (t, cell, dof), ``units`` has their units by name, ``across`` is the number of
    nodes of a cell, ``mesh`` their topology and geometry.
    """
    masses = shape[2] // across
    nodes = _words((shape[1], across))
    grid = Xml.Element("Grid", Name="sample {row}", GridType="Uniform")
    _child(grid, "Time", Value="{time!r}")
    grid.extend(mesh)

    for name, unit in units.items():
        for mass in range(masses):
            # The masses of a row follow each other in the wide cell.
            number = f" {mass + 1}" if masses > 1 else ""
            about = {"Name": f"{name}{number} ({unit})", "AttributeType": "Scalar", "Center": "Node"}
            node = _child(grid, "Attribute", **about)
            slab = _child(node, "DataItem", ItemType="HyperSlab", Dimensions=nodes)
            start_stride_count = f"{{row}} 0 {mass} 1 1 {masses} 1 {nodes}"
            _child(slab, "DataItem", start_stride_count, Dimensions="3 3", Format="XML")
            source = {"Format": "HDF", "NumberType": "Float", "Precision": "8", "Dimensions": _words(shape)}
            _child(slab, "DataItem", f"run.h5:/{name}", **source)
    Xml.indent(grid, " ")
    return Xml.tostring(grid, "unicode") + "\n"


def has_xdmf(folder: Path) -> bool:
    """Return whether ``run.xdmf`` exists and is not older than ``run.h5``."""
    mesh = folder / "run.xdmf"
    run = folder / "run.h5"
    return mesh.exists() and mesh.stat().st_mtime_ns >= run.stat().st_mtime_ns


def _child(parent: Xml.Element, tag: str, text: str | None = None, **attributes: str) -> Xml.Element:
    """Add an element to ``parent``, and return it."""
    child = Xml.SubElement(parent, tag, attributes)
    child.text = text
    return child


def _words(values: Iterable[float]) -> str:
    """Return numbers separated by blanks, in 17 digits, which tell all doubles apart."""
    return " ".join(f"{value:.17g}" for value in values)


def write_curves(path: Path) -> list[Path]:
    """Write the curves of the results in ``path`` as CSV files to ``curves/`` in their folder; return the files.

    Variables over one dimension, or over all axes of a sweep, are a table: a row for each point, coordinates first,
    units in the head. Variables over the same dimensions share one. Some results have further columns or tables:

    - designs of a search: a column for each variable, objective and constraint;
    - a frequency response: a column for each named mass, contact and wall;
    - a run: ``run-impacts.csv``, a row for each impact (``vipetsc.io.impacts``);
    - a run with points or forces: ``run-points.csv`` and ``run-forces.csv``, a column for each point or site;
    - a run or an analysis, where the folder has ``analysis.h5``: the numbers in it, ``analysis-measures.csv``.

    Fields and maps are left out, and tables of more than ``MOST_ROWS`` rows or ``MOST_NUMBERS`` numbers. Raises OSError
    or ValueError as ``open_results``, OSError if a file cannot be written.
    """
    written = []
    with open_results(path) as data:
        source = Path(data.encoding.get("source", path / "ensemble.h5"))
        # Only a sweep has a status, which each of its members has.
        axes: tuple[Any, ...] = ()
        if "status" in data:
            axes = data["status"].dims
        groups: dict[tuple[str, ...], list[str]] = {}
        for name, item in data.data_vars.items():
            if len(item.dims) == 1 or (axes and item.dims == axes):
                groups.setdefault(tuple(map(str, item.dims)), []).append(str(name))

        for dims, names in groups.items():
            # The impacts of a run have a table of their own.
            if dims == ("episode",) or np.prod([data.sizes[dim] for dim in dims]) > MOST_ROWS:
                continue
            table = data[names].assign(_columns_of_designs(data, dims) | _columns_of_responses(data, dims))
            # CSV has no room for coordinates over other dimensions, such as the cells of sites.
            foreign = [name for name, item in table.coords.items() if not set(item.dims) <= set(dims)]
            # Each table has a file of its own, named by the dimensions.
            over = "-".join(dims)
            if dims == axes:
                over = "members"
            stem = f"{source.stem}-{over}".replace("/", "-")
            path_of_table = source.parent / "curves" / f"{stem}.csv"
            written.append(_write_table(path_of_table, table.drop_vars(foreign)))
        written += _write_wide(data, source)
        if 0 < data.sizes.get("episode", 0) <= MOST_ROWS:
            written.append(_write_impacts(source))

    # The numbers of a run are in another file of its folder.
    measured = source.with_name(ANALYSIS)
    if source.name in ("run.h5", ANALYSIS) and measured.exists():
        with open_results(measured) as analysis:
            numbers = _numbers(analysis)
        if numbers["measure"]:
            written.append(_write_columns(measured.parent / "curves" / f"{measured.stem}-measures.csv", numbers))
    return written


def _columns_of_designs(data: xr.Dataset, dims: tuple[str, ...]) -> dict[str, xr.DataArray]:
    """Return columns (design,) for the variables, objectives and constraints of a search, by their labels.

    There are no columns if ``data`` are not a search, or ``dims``, those of a table, are not those of its designs.
    """
    columns = {}
    for name, label in DESIGN_LABELS.items():
        if name not in data or data[name].dims != (*dims, label):
            continue
        units = ["1"] * data.sizes[label]
        if label == "variable":
            units = data["unit"].values.tolist()
        for text, unit, values in zip(data[label].values, units, data[name].values.T, strict=True):
            columns[str(text)] = xr.DataArray(values, dims=dims, attrs={"units": unit})
    return columns


def _columns_of_responses(data: xr.Dataset, dims: tuple[str, ...]) -> dict[str, xr.DataArray]:
    """Return columns (point,) of a frequency response for each mass, contact or wall, by variable and label.

    There are no columns if ``data`` are no response, or ``dims``, those of a table, are not those of its points.
    """
    columns: dict[str, xr.DataArray] = {}
    if dims != ("point",) or data.attrs.get("branch_kind") != RESPONSES:
        return columns
    for name, item in data.data_vars.items():
        if len(item.dims) == 2 and item.dims[1] in RESPONSE_LABELS:
            for label, values in zip(data[item.dims[1]].values, item.values.T, strict=True):
                columns[f"{name}/{label}"] = xr.DataArray(values, dims=dims, attrs={"units": item.attrs["units"]})
    return columns


def _write_wide(run: xr.Dataset, source: Path) -> list[Path]:
    """Write the motion of points and the forces at sites over time, a column for each point or site; return the files.

    Nothing is written for results that are no ``run``, or that recorded neither. Files are named after ``source``.
    """
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


def _write_impacts(source: Path) -> Path:
    """Write the table of impacts of the run in the file ``source`` as CSV, with units in its head; return the file."""
    table = impacts(source)
    heads = {name: with_unit(name, unit) for name, unit in table.attrs["units"].items()}
    path = source.parent / "curves" / f"{source.stem}-impacts.csv"
    return _write_frame(path, table.rename(columns=heads).reset_index())


def _numbers(analysis: xr.Dataset) -> dict[str, list[Any]]:
    """Return columns of a table with a row for each number in an ``analysis``, and each part of the frequency axis."""
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
    """Write a table of ``columns`` of one length as CSV; their names are its heads."""
    rows = xr.Dataset({head: ("row", np.asarray(values)) for head, values in columns.items()})
    return _write_frame(path, rows.to_dataframe())


def _write_frame(path: Path, frame: Any) -> Path:
    """Write a pandas ``frame`` as CSV, each number in the shortest text that reads back as the same."""
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as aside:
        frame.to_csv(aside, index=False)
    return path
