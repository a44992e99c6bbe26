"""Files of branches: variables from the fields of their points, and the points again from the variables.

All kinds of branches have the number and the kind of every point, and how the branch ended. A ``Format`` has what else
a kind has: normal modes the ``POINT_VARIABLES`` of their orbits with the initial values (shooting) or the harmonics
(harmonic balance), curves of steady states the measures of ``spectra.responses``. Fields of different lengths are
padded. The table of a branch (CSV) has columns of the same variables (``TABLES``).
"""

import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from vipetsc.endings import Ended, Ending
from vipetsc.io.atomic import write_text
from vipetsc.io.branch_kinds import BALANCE, DAMPED, ORBITS, RESPONSES, kind_of_file
from vipetsc.io.netcdf import Variables, open_netcdf, variable, write_netcdf
from vipetsc.modes.branches.branch import Branch, kinds_in, stored_kinds
from vipetsc.modes.branches.regions import quantity, regions, slope_laws, tongues
from vipetsc.modes.branches.sweeps import measure, outputs_of, sweep_down, sweep_up
from vipetsc.modes.point import OF_LOSSES, POINT_VARIABLES, Point
from vipetsc.modes.response.state import Measures, Response
from vipetsc.modes.stability import UNSTABLE_BEYOND
from vipetsc.spectra.responses import LAYOUT, OUTPUTS

REGION = "region of the backbone: 1 linear, 2 grazing, 3 vibro-impact, 4 smooth limit; 0 unknown"
PHASE = (
    "the drive is A cos(Om t), and harmonics are those of exp(i k Om t); a run's drive is A sin(Om t), with which the "
    "harmonic k is to be multiplied by (-i)^k"
)
AT_REST = "initial displacement (velocity in m/s for maps from the centre)"
PASSED = "points visited as the parameter increases slowly; a jump where they are not neighbours"
# Columns of the tables of normal modes, and the variables of which they are. Those with several values are numbered.
OF_ALL = ("multiplier_max", "slope", *OF_LOSSES, "contacts", "region")
TABLES = {
    ORBITS: {"x": "initial", "half_trace": "half_trace", "half_trace_imaginary": "half_trace_imaginary"},
    DAMPED: {"w": "elongation"},
    BALANCE: {"w": "elongation", "harmonics": "harmonics_kept", "truncation": "truncation"},
}


class Format(NamedTuple):
    """The file of one kind of branch.

    ``needs`` are variables or attributes that it must have, and ``counted`` the dimension whose size is
    ``Branch.dofs``. ``variables`` takes a branch, ``points`` a file's dataset.
    """

    needs: tuple[str, ...]
    counted: str
    variables: Callable[[Branch[Any]], Variables]
    points: Callable[[xr.Dataset], Sequence[Any]]


def write_branch(branch: Branch[Any], folder: Path, about: dict[str, Any]) -> None:
    """Write ``branch-<name>.h5`` and ``.csv``, each complete or as it was; ``about`` are further attributes."""
    sys.audit("vipetsc.save", branch.name)
    data = to_dataset(branch)
    # The HDF5 file last: it says whether a branch is complete, and what is complete is not written again.
    write_text(folder / f"branch-{branch.name}.csv", table(data, branch.kind))
    write_netcdf(folder / f"branch-{branch.name}.h5", data.assign_attrs(about))


def restore_table(branch: Branch[Any], folder: Path) -> None:
    """Write the ``.csv`` of a branch whose HDF5 file is there if somebody has removed it."""
    path = folder / f"branch-{branch.name}.csv"
    if not path.exists():
        write_text(path, table(to_dataset(branch), branch.kind))


def to_dataset(branch: Branch[Any]) -> xr.Dataset:
    """Return the branch as the dataset of its file."""
    # Codes are stored with their meanings, by which they are read: lists of kinds may grow.
    names = kinds_in(branch)
    kinds = np.array([names.index(p.kind) for p in branch.points], np.int8)
    flags = {"flag_values": np.arange(len(names), dtype=np.int8), "flag_meanings": " ".join(names)}

    attributes = {
        "name": branch.name,
        "case": branch.case,
        "branch_kind": branch.kind,
        "complete": int(branch.complete),
        "ending": branch.ended.sentence,
        "ended": branch.ended.ending.name,
        "warnings": json.dumps(branch.findings + branch.missing),
        "missing": json.dumps(branch.missing),
        **branch.about,
    }
    if branch.kind == RESPONSES:
        attributes["phase"] = PHASE
    else:
        attributes |= {"next_step": branch.next_step, "fits": slope_laws(branch), "tongues": len(tongues(branch))}

    data = {
        "point": variable("point", np.arange(len(branch.points)), "1", "place along the branch"),
        "kind": variable("point", kinds, "1", "kind of point", **flags),
        **FORMATS[branch.kind].variables(branch),
        **branch.extra,
    }
    return xr.Dataset(data, attrs=attributes)


def read_branch(path: Path) -> Branch[Any]:
    """Return the branch in an HDF5 file, without its ``extra``; raises OSError or ValueError if it holds none."""
    # The kind comes first: what a file must have depends on it, and a message about what it lacks should be right.
    kind = kind_of_file(path, ("tangent",))
    form = FORMATS[kind]
    with open_netcdf(path, "branch", form.needs) as file:
        data = file.load()
    about = data.attrs
    warnings = json.loads(about["warnings"])
    missing = json.loads(about["missing"])
    next_step = about.get("next_step")
    if next_step is None:
        # Files of responses have the next step at each point, and none for the branch.
        next_step = data["next_step"].values[-1]
    return Branch(
        name=str(about["name"]),
        case=str(about["case"]),
        dofs=int(data.sizes[form.counted]),
        kind=kind,
        points=list(form.points(data)),
        next_step=float(next_step),
        ended=Ended(Ending[str(about["ended"])], str(about["ending"])),
        findings=warnings[: len(warnings) - len(missing)],
        missing=missing,
        about={name: str(about[name]) for name in ("over", "unit") if name in about},
    )


def table(data: xr.Dataset, kind: str) -> str:
    """Return the table of a branch for CSV, with numbers in full precision; without the harmonics of steady states."""
    columns: dict[str, list[Any]] = {}
    if kind == RESPONSES:
        names = [name for name in LAYOUT | OUTPUTS if name in data and "order" not in data[name].dims]
        sources = {name: name for name in names}
    else:
        sources = {name: name for name in ("energy", "frequency", "period")} | TABLES[kind]
        sources |= {name: name for name in OF_ALL if name in data}

    for name, source in sources.items():
        values = data[source].values
        values = values.reshape(len(values), math.prod(values.shape[1:]))
        # Half-traces are complex where two pairs have met, and real otherwise.
        if source == "half_trace_imaginary" and not values.any():
            continue
        labels = [f"_{i}" for i in range(1, values.shape[1] + 1)]
        if name in OUTPUTS and OUTPUTS[name].dimensions not in ("", "site"):
            labels = [f"/{label}" for label in data[OUTPUTS[name].dimensions].values]
        elif name in ("x", "w"):
            labels = [label[1:] for label in labels]
        elif len(labels) == 1:
            labels = [""]
        columns |= {name + label: column.tolist() for label, column in zip(labels, values.T, strict=True)}

    columns["kind"] = stored_kinds(data)
    rows = [map(str, row) for row in zip(*columns.values(), strict=True)]
    return "".join(",".join(row) + "\n" for row in [columns, *rows])


def _padded(rows: Sequence[np.ndarray], fill: float = np.nan) -> np.ndarray:
    """Return arrays (..., length) with all dimensions but the last in common, padded to the longest, as one array."""
    if not rows:
        return np.empty((0, 0))
    longest = max(row.shape[-1] for row in rows)
    out = np.full((len(rows), *rows[0].shape[:-1], longest), fill, np.result_type(float, *rows))
    for padded, row in zip(out, rows, strict=True):
        padded[..., : row.shape[-1]] = row
    return out


def _nnm_variables(branch: Branch[Point]) -> Variables:
    """Return variables of all branches of normal modes: the quantities, the regions and losses."""
    data = {"region": variable("point", regions(branch).astype(np.int64), "1", REGION)}
    for name, (stored, _, units, text) in POINT_VARIABLES.items():
        data[stored] = variable("point", quantity(branch, name), units, text)
    data["multiplier_max"].attrs["unstable_beyond"] = UNSTABLE_BEYOND
    tangent_period = np.array([p.tangent[-1] if p.tangent.size else np.nan for p in branch.points])
    data["tangent_period"] = variable("point", tangent_period, "s", "tangent of the branch: period")

    # Motions along which nothing dissipates have no loss.
    for name, (units, text) in OF_LOSSES.items():
        values = branch.column(name).astype(float)
        if np.isfinite(values).any():
            data[name] = variable("point", values, units, text)
    return data


def _nnm_fields(data: xr.Dataset) -> list[dict[str, Any]]:
    """Return fields of ``Point`` that all normal modes have, of every point in a file, by their names."""
    columns: dict[str, Any] = {name: data[stored].values.tolist() for name, (stored, *_) in POINT_VARIABLES.items()}
    columns |= {name: data[name].values.tolist() for name in OF_LOSSES if name in data}
    columns["kind"] = stored_kinds(data)
    # Properties of ``Point``, which follow from other fields.
    for name in ("frequency", "damping_ratio"):
        columns.pop(name, None)
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _orbit_variables(branch: Branch[Point]) -> Variables:
    """Return initial values, tangents and half-traces of shot orbits; orbits of whole lattices have no half-traces."""
    n = branch.dofs
    pairs = n - 1
    if branch.points:
        pairs = len(branch.points[0].half_traces)
    x = branch.column("x").reshape(-1, n)
    tangent = branch.column("tangent").astype(float).reshape(-1, n + 1)
    traces = branch.column("half_traces").astype(complex).reshape(len(branch.points), pairs)
    return _nnm_variables(branch) | {
        "dof": variable("dof", np.arange(1, n + 1), "1", "degree of freedom, from 1"),
        "pair": variable("pair", np.arange(1, pairs + 1), "1", "pair of multipliers, without the trivial one"),
        "initial": variable(("point", "dof"), x, "m", AT_REST),
        "tangent": variable(("point", "dof"), tangent[:, :-1], "m", "tangent of the branch: initial values"),
        "half_trace": variable(("point", "pair"), traces.real, "1", "Floquet half-trace, real part"),
        "half_trace_imaginary": variable(("point", "pair"), traces.imag, "1", "Floquet half-trace, imaginary part"),
    }


def _orbits(data: xr.Dataset) -> list[Point]:
    """Return the shot orbits of a file."""
    tangents = np.column_stack([data["tangent"].values, data["tangent_period"].values])
    traces = data["half_trace"].values + 1j * data["half_trace_imaginary"].values
    points = []
    for fields, x, tangent, c in zip(_nnm_fields(data), data["initial"].values, tangents, traces, strict=True):
        # Half-traces are real but where two pairs have met: their array keeps its type through a file.
        if not np.any(c.imag != 0):
            c = c.real
        points.append(Point(**fields, x=x, tangent=tangent, half_traces=c))
    return points


def _elongation_variables(branch: Branch[Point]) -> Variables:
    """Return harmonics of the elongations at contacts and springs, the pairs, and their tangents."""
    points = branch.points
    pairs = branch.dofs
    harmonics = _padded([p.x.reshape(pairs, -1) for p in points], fill=0.0)
    harmonics = harmonics.reshape(len(points), pairs, harmonics.shape[-1])
    # The first point of a branch that has gone no further has no tangent.
    directions = [p.tangent[:-1] if p.tangent.size else 0 * p.x for p in points]
    tangent = _padded([d.reshape(pairs, -1) for d in directions], fill=0.0).reshape(harmonics.shape)

    # Points of one branch differ in their number of harmonics, but all have odd ones alone or none does.
    orders = np.arange(harmonics.shape[-1])
    if all(p.order % 2 and len(p.x) <= p.order // 2 * pairs + pairs for p in points):
        orders = 2 * orders + 1
    axes = "point", "pair", "order"
    return _nnm_variables(branch) | {
        "order": variable("order", orders, "1", "harmonic of the frequency"),
        "harmonics": variable(axes, harmonics, "m", "cosine of the elongation (of a contact, w)"),
        "tangent": variable(axes, tangent, "m", "tangent of the branch: harmonics"),
        **_balance_variables(branch),
    }


def _balance_variables(branch: Branch[Point]) -> Variables:
    """Return what all motions by harmonic balance have: elongations, and how many harmonics."""
    elongations = branch.column("elongations").astype(float).reshape(len(branch.points), branch.dofs)
    left_out = "estimated size of the neglected harmonics over that of the motion"
    return {
        "pair": variable("pair", np.arange(1, branch.dofs + 1), "1", "contact, then smooth spring"),
        "elongation": variable(("point", "pair"), elongations, "m", "elongation at phase 0"),
        "harmonics_kept": variable("point", branch.column("order").astype(int), "1", "number of the last harmonic"),
        "truncation": variable("point", branch.column("truncation").astype(float), "1", left_out),
    }


def _balance_fields(data: xr.Dataset) -> list[dict[str, Any]]:
    """Return fields of ``Point`` that all motions by harmonic balance have, of every point in a file."""
    points = _nnm_fields(data)
    for i, fields in enumerate(points):
        fields["order"] = int(data["harmonics_kept"].values[i])
        fields["truncation"] = float(data["truncation"].values[i])
        fields["elongations"] = data["elongation"].values[i]
    return points


def _damped_variables(branch: Branch[Point]) -> Variables:
    """Return the unknowns of damped modes, and their tangents, padded with NaN to the most harmonics."""
    points = branch.points
    x = _padded([p.x for p in points])
    # The first point of a branch that has gone no further has no tangent.
    tangent = np.full(x.shape, np.nan)
    for row, point in zip(tangent, points, strict=True):
        row[: max(len(point.tangent) - 1, 0)] = point.tangent[:-1]
    text = "the damping ratio; then, mass by mass, cosines of all harmonics and minus their sines (m)"
    return _nnm_variables(branch) | {
        "unknown": variable("unknown", np.arange(1, x.shape[1] + 1), "1", "number of the unknown"),
        "x": variable(("point", "unknown"), x, "1", text),
        "tangent": variable(("point", "unknown"), tangent, "1", "tangent of the branch"),
        **_balance_variables(branch),
    }


def _damped_modes(data: xr.Dataset) -> list[Point]:
    """Return the damped modes of a file."""
    points = []
    for i, fields in enumerate(_balance_fields(data)):
        x = data["x"].values[i]
        tangent = np.append(data["tangent"].values[i], data["tangent_period"].values[i])
        points.append(Point(**fields, x=x[np.isfinite(x)], zeta=float(x[0]), tangent=tangent[np.isfinite(tangent)]))
    return points


def _elongation_motions(data: xr.Dataset) -> list[Point]:
    """Return the motions by harmonic balance of a file."""
    points = []
    for i, fields in enumerate(_balance_fields(data)):
        count = int(np.count_nonzero(data["order"].values <= fields["order"]))
        tangent_period = data["tangent_period"].values[i]
        tangent = np.empty(0)
        if np.isfinite(tangent_period):
            tangent = np.append(data["tangent"].values[i, :, :count].ravel(), tangent_period)
        points.append(Point(**fields, x=data["harmonics"].values[i, :, :count].ravel(), tangent=tangent))
    return points


def _response_variables(branch: Branch[Response]) -> Variables:
    """Return steady states, their measures, and the states that a slow sweep of the parameter passes."""
    xi = branch.column("xi")
    up = np.array(sweep_up(branch), int)
    down = np.array(sweep_down(branch), int)
    data = {
        "unknown": variable("unknown", np.arange(xi.shape[1]), "1", "unknown; the last is the parameter"),
        "xi": variable(("point", "unknown"), xi, "1", "unknowns"),
        "tangent": variable(("point", "unknown"), branch.column("tangent"), "1", "unit tangent"),
        "step": variable("point", branch.column("step"), "1", "arclength of the step that led here"),
        "next_step": variable("point", branch.column("next_step"), "1", "arclength of the next step"),
        "up": variable("up", np.arange(len(up)), "1", "place in the sweep up"),
        "down": variable("down", np.arange(len(down)), "1", "place in the sweep down"),
        "up_point": variable("up", up, "1", PASSED),
        "down_point": variable("down", down, "1", "points visited as the parameter decreases slowly"),
    }
    for name, (dimensions, units, text) in (LAYOUT | outputs_of(branch)).items():
        if name == "parameter":
            units = branch.about["unit"]
        data[name] = variable(["point", *dimensions.split()], measure(branch, name), units, text)
    return data


def _responses(data: xr.Dataset) -> list[Response]:
    """Return the steady states of a file."""
    kinds = stored_kinds(data)
    # Numbers are not stored: a special point has that of the regular point after it.
    regular = np.array([kind == "regular" for kind in kinds])
    numbers = np.cumsum(regular) - regular
    points = []
    for i, kind in enumerate(kinds):
        row = {name: data[name].values[i] for name in LAYOUT}
        # A sum of both parts would lose the signs of zeros, and with them the bits of a curve that is resumed.
        harmonics = np.empty(row["harmonics"].shape, complex)
        harmonics.real = row.pop("harmonics")
        harmonics.imag = row.pop("harmonics_imaginary")
        fields = {name: value if value.ndim else value.item() for name, value in row.items()}
        fields["fractions"] = fields.pop("share")
        outputs = {name: data[name].values[i] for name in OUTPUTS if name in data}
        points.append(
            Response(
                xi=data["xi"].values[i],
                tangent=data["tangent"].values[i],
                index=int(numbers[i]),
                step=float(data["step"].values[i]),
                next_step=float(data["next_step"].values[i]),
                kind=kind,
                measures=Measures(**fields, harmonics=harmonics, outputs=outputs),
            )
        )
    return points


def stored_states(points: list[Point], cells: Sequence[int], u: np.ndarray) -> Variables:
    """Return displacements ``u`` (point, cell, dof) in m of ``cells``, from 0, at phase 0: runs can begin with them."""
    # Velocities of zero are stored because ``io.state`` reads any state alike, as displacement and velocity.
    axes = "orbit", "states/cell", "states/mass"
    return {
        "orbit": variable("orbit", np.arange(1, len(points) + 1), "1", "stored motion"),
        "states/cell": variable("states/cell", np.array(cells) + 1, "1", "cell, from 1"),
        "states/mass": variable("states/mass", np.arange(1, u.shape[2] + 1), "1", "mass of the cell, from 1"),
        "states/displacement": variable(axes, u, "m", "displacement at phase 0; cells left out are at rest"),
        "states/velocity": variable(axes, 0 * u, "m/s", "velocity at phase 0"),
        "states/energy": variable("orbit", [p.energy for p in points], "J", "energy"),
        "states/period": variable("orbit", [p.period for p in points], "s", "period"),
        "states/number": variable("orbit", [p.index for p in points], "1", "number of the regular point"),
    }


FORMATS = {
    ORBITS: Format(("point", "tangent", "half_trace", "next_step"), "dof", _orbit_variables, _orbits),
    BALANCE: Format(("point", "harmonics", "tangent", "next_step"), "pair", _elongation_variables, _elongation_motions),
    DAMPED: Format(("point", "x", "tangent", "next_step"), "pair", _damped_variables, _damped_modes),
    RESPONSES: Format(("xi", "tangent", "next_step"), "site", _response_variables, _responses),
}
