"""A state of a lattice from a file: a sample of a run, an orbit of a branch, or a state alone."""

import tomllib
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from vipetsc.io.netcdf import open_netcdf


class State(NamedTuple):
    """Displacement (cell, dof) in m and velocity in m/s of some cells, which count from 1; others are at rest.

    ``time`` in s is that of a run's sample, ``orbit`` the number of a branch's orbit, ``period`` in s that of an orbit;
    ``case`` is the resolved case of a run. Each is None if the file does not contain it.
    """

    cell: np.ndarray
    displacement: np.ndarray
    velocity: np.ndarray
    time: float | None = None
    orbit: int | None = None
    period: float | None = None
    case: str | None = None

    @classmethod
    def read(cls, path: str | Path, time: float | None = None, orbit: int | None = None) -> Self:
        """The sample of a run that is nearest to ``time``, or its last; the ``orbit`` of a branch, or its last.

        Raises OSError if the file cannot be opened, ValueError if it holds no state, or not that one.
        """
        with open_netcdf(path, "state") as file:
            prefix = "states/" if "states/displacement" in file else ""
            names = [prefix + name for name in ("displacement", "velocity", "cell")]
            missing = [name for name in names if name not in file]
            if missing:
                raise ValueError(f"{path} contains no state: it lacks {', '.join(missing)}")
            u, v, cell = (file[name] for name in names)

            origin: dict[str, Any] = {}  # which state of the file it is
            if prefix:
                row = _row(np.arange(1, len(u) + 1), orbit, 0.5, f"{path} has orbits")
                origin = {"orbit": row + 1, "period": float(file["states/period"][row])}
            elif u.ndim == 3:
                times = file[str(u.dims[0])].values
                interval = np.inf
                if len(times) > 1:
                    interval = float(times[1] - times[0])
                row = _row(times, time, 0.5 * interval, f"{path} has samples in s")
                origin = {"time": float(times[row]), "case": file.attrs.get("case")}
            if u.ndim == 3:  # read one state, not all
                u = u[row]
                v = v[row]
            state = cls(
                cell=cell.values.astype(np.int64),
                displacement=np.asarray(u, float),
                velocity=np.asarray(v, float),
                **origin,
            )

        if not (np.isfinite(state.displacement).all() and np.isfinite(state.velocity).all()):
            raise ValueError(f"{path} contains a state with values that are not finite")
        return state

    def on(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """Displacement and velocity (cell, dof) of cells ``start`` to ``stop`` (0-based, half open)."""
        inside = (self.cell > start) & (self.cell <= stop)
        rows = self.cell[inside] - 1 - start
        u, v = np.zeros((2, stop - start, self.velocity.shape[1]))
        u[rows] = self.displacement[inside]
        v[rows] = self.velocity[inside]
        return u, v

    def moving(self) -> frozenset[int]:
        """The cells (1-based) of which some mass moves or is displaced."""
        is_moving = np.any((self.displacement != 0) | (self.velocity != 0), axis=1)
        return frozenset(self.cell[is_moving].tolist())

    def frequency(self) -> float | None:
        """Frequency in rad/s of an orbit, of a run's drive or of the motion it began with; None for a state alone."""
        if self.period:
            return 2 * np.pi / self.period
        if self.case:
            case = tomllib.loads(self.case)
            return float(case["drive"].get("frequency") or case["initial"]["frequency"])
        return None

    def largest(self, frequency: float) -> tuple[float, int]:
        """Largest displacement, or velocity over ``frequency`` in rad/s, in m, and the cell (1-based) that has it."""
        if not self.cell.size:
            return 0.0, 1
        # A velocity over the frequency is the displacement that the motion swings to.
        sizes = np.maximum(np.abs(self.displacement), np.abs(self.velocity) / frequency).max(axis=1, initial=0.0)
        return float(sizes.max()), int(self.cell[np.argmax(sizes)])


def _row(values: np.ndarray, wanted: float | None, reach: float, text: str) -> int:
    """The row of the value ``wanted``, within ``reach``, or the last one; raises ValueError, which ``text`` begins."""
    if not len(values):
        raise ValueError(f"{text.split(' has ')[0]} contains no state: it is empty")
    if wanted is None:
        return len(values) - 1
    row = int(np.argmin(np.abs(values - wanted)))
    if abs(values[row] - wanted) > reach:
        raise ValueError(f"{text} from {values[0]:g} to {values[-1]:g}, not {wanted:g}")
    return row
