"""Files of curves of steady states."""

from typing import Any

import numpy as np
import xarray as xr

from vipetsc.io.netcdf import Variables, variable
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.kinds import stored_kinds
from vipetsc.modes.branches.layout import Table
from vipetsc.modes.branches.sweeps import ParameterSweep, swept, with_stable_folds
from vipetsc.modes.response.state import Measures, Response
from vipetsc.spectra.responses import LAYOUT, OUTPUTS, Stored

PHASE = (
    "the drive is A cos(Om t), and harmonics are those of exp(i k Om t); a run's drive is A sin(Om t), with which the "
    "harmonic k is to be multiplied by (-i)^k"
)


def outputs_of(branch: Branch[Response]) -> dict[str, Stored]:
    """The outputs that the states of a curve have."""
    if not branch.points:
        return {}
    present = branch.points[0].measured.outputs
    return {name: stored for name, stored in OUTPUTS.items() if name in present}


def measure(branch: Branch[Response], stored: str) -> np.ndarray:
    """A measure or an output (state, ...) of every state, by its name in the file."""
    if stored in OUTPUTS:
        return np.array([p.measured.outputs[stored] for p in branch.points])
    if stored == "harmonics":
        return np.array([p.measured.harmonics.real for p in branch.points])
    if stored == "harmonics_imaginary":
        return np.array([p.measured.harmonics.imag for p in branch.points])
    if stored == "share":
        return np.array([p.measured.fractions for p in branch.points])
    return np.array([getattr(p.measured, stored) for p in branch.points])


def parameter_values(branch: Branch[Response]) -> np.ndarray:
    """The value (point,) of the parameter that varies along a curve."""
    over = str(branch.about["over"])
    if over in LAYOUT:
        return measure(branch, over)
    return measure(branch, "parameter")  # a key of the case


class ResponseLayout:
    """Steady states, their measures, and the states that a slow sweep of the parameter passes."""

    noun = "curve"
    needs = ("xi", "tangent", "next_step")

    def variables(self, branch: Branch[Response]) -> Variables:
        """Variables of a curve's file; those of its lattice are in ``Branch.extra``."""
        xi = branch.column("xi")
        up = np.array(sweep_up(branch), int)
        down = np.array(sweep_down(branch), int)

        passed = "points visited as the parameter increases slowly; a jump where they are not neighbours"
        data = {
            "unknown": variable("unknown", np.arange(xi.shape[1]), "1", "unknown; the last is the parameter"),
            "xi": variable(("point", "unknown"), xi, "1", "unknowns"),
            "tangent": variable(("point", "unknown"), branch.column("tangent"), "1", "unit tangent"),
            "step": variable("point", branch.column("step"), "1", "arclength of the step that led here"),
            "next_step": variable("point", branch.column("next_step"), "1", "arclength of the next step"),
            "up": variable("up", np.arange(len(up)), "1", "place in the sweep up"),
            "down": variable("down", np.arange(len(down)), "1", "place in the sweep down"),
            "up_point": variable("up", up, "1", passed),
            "down_point": variable("down", down, "1", "points visited as the parameter decreases slowly"),
        }
        for name, (dimensions, units, text) in (LAYOUT | outputs_of(branch)).items():
            if name == "parameter":
                units = branch.about["unit"]
            data[name] = variable(["point", *dimensions.split()], measure(branch, name), units, text)
        return data

    def attributes(self, branch: Branch[Response]) -> dict[str, Any]:
        """What the phases of harmonics refer to, which is not what they refer to in runs."""
        return {"phase": PHASE}

    def table(self, branch: Branch[Response]) -> Table:
        """The table of a curve for CSV, without harmonics."""
        count = len(branch.points)
        columns: dict[str, list[Any]] = {}
        for name, stored in (LAYOUT | outputs_of(branch)).items():
            if "order" in stored.dimensions:
                continue

            values = measure(branch, name).reshape(count, -1)
            if name in OUTPUTS and stored.dimensions not in ("", "site"):
                labels = branch.extra[stored.dimensions].values
                columns |= {f"{name}/{label}": column.tolist() for label, column in zip(labels, values.T, strict=True)}
            elif values.shape[1] == 1:
                columns[name] = values[:, 0].tolist()
            else:
                columns |= {f"{name}_{i}": column.tolist() for i, column in enumerate(values.T, 1)}

        columns["kind"] = [p.kind for p in branch.points]
        rows = [[str(value) for value in row] for row in zip(*columns.values(), strict=True)]
        return Table(list(columns), rows)

    def points(self, data: xr.Dataset) -> list[Response]:
        """The states of a file."""
        # Files of earlier versions have no steps.
        steps = np.zeros(data.sizes["point"])
        if "step" in data:
            steps = data["step"].values

        points = []
        # Numbers are not stored: a fold has that of the regular point after it.
        index = 0
        for i, kind in enumerate(stored_kinds(data)):
            row = {name: data[name].values[i] for name in LAYOUT if name in data}

            measures = Measures(
                frequency=float(row["frequency"]),
                amplitude=float(row["amplitude"]),
                largest=row["largest"],
                fractions=row["share"],
                unstable=int(row["unstable"]),
                growth=float(row["growth"]),
                # Files of earlier versions have none.
                sideband=float(row.get("sideband", np.nan)),
                closed=row["closed"],
                episodes=int(row["episodes"]),
                truncation=float(row["truncation"]),
                harmonics=_complex(row["harmonics"], row["harmonics_imaginary"]),
                outputs={name: data[name].values[i] for name in OUTPUTS if name in data},
            )
            points.append(
                Response(
                    xi=data["xi"].values[i],
                    tangent=data["tangent"].values[i],
                    index=index,
                    step=float(steps[i]),
                    next_step=float(data["next_step"].values[i]),
                    kind=kind,
                    measures=measures,
                )
            )
            index += kind == "regular"
        return points

    def dofs(self, data: xr.Dataset) -> int:
        """Number of sites of the lattice of a curve in a file."""
        return int(data.sizes["site"])


def sweep_up(branch: Branch[Response]) -> list[int]:
    """States that a slow growth of the parameter passes, from the first stable one."""
    return swept(_sweep(branch, 1))


def sweep_down(branch: Branch[Response]) -> list[int]:
    """States that a slow fall of the parameter passes, from the last of the sweep up."""
    passed = sweep_up(branch)
    if not passed:
        return []
    return swept(_sweep(branch, -1), passed[-1])


def _sweep(branch: Branch[Response], sign: int) -> ParameterSweep:
    """The states of a curve for a sweep up (``sign`` 1) or down (-1)."""
    # With the sign a sweep down is one up as well; -1 unstable perturbations mean that stability is undecided.
    stable = measure(branch, "unstable") == 0
    fold = branch.is_kind("fold")
    parameter = sign * parameter_values(branch)
    # The first contact stands for the state; without contacts the first spring that is not linear.
    name = "largest_elongation"
    if branch.dofs:
        name = "largest"
    return ParameterSweep(parameter, size=measure(branch, name)[:, 0], stable=with_stable_folds(stable, fold))


def _complex(real: np.ndarray, imaginary: np.ndarray) -> np.ndarray:
    """The complex array with the parts ``real`` and ``imaginary``, signs of zeros included."""
    # real + 1j * imag would lose them, and with them the bits of a curve that is resumed.
    out = np.empty(real.shape, complex)
    out.real = real
    out.imag = imaginary
    return out
