"""A state of a lattice from a file: a sample of a run, an orbit of a branch, or a state alone."""

import tomllib
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np


class State(NamedTuple):
    """``displacement`` (cell, dof) in m and ``velocity`` in m/s of the cells ``cell``, from 1; all others are at rest.

    ``time`` in s is that of a run's sample, ``orbit`` the number of a branch's orbit, from 1, ``period`` in s its
    period, ``case`` the resolved case (TOML) of a run. Each is None if the file does not contain it.
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
        """Read a state from a file: a sample of a run, an orbit of a branch, or the only state that there is.

        The state of a run is the sample nearest to ``time`` (s), that of a branch is the orbit with the number
        ``orbit``; the last one is the default. A key that the file has no use for is ignored. Raises OSError if the
        file cannot be opened, ValueError if it holds no state, not that one, or numbers that are not finite.
        """
        # Most cases begin at rest, and are read without h5py.
        from vipetsc.io.netcdf import open_netcdf

        with open_netcdf(path, "state") as file:
            # A branch has its states in a group of their own.
            prefix = ""
            if "states/displacement" in file:
                prefix = "states/"
            names = [prefix + name for name in ("displacement", "velocity", "cell")]
            needed = names
            if prefix:
                needed = [*names, "states/period"]
            missing = [name for name in needed if name not in file]
            if missing:
                raise ValueError(f"{path} contains no state: it lacks {', '.join(missing)}")
            u, v, cell = (file[name] for name in names)

            # Which state of the file it is; a file may hold a single one.
            origin: dict[str, Any] = {}
            if prefix:
                row = _row(np.arange(1, len(u) + 1), orbit, reach=0.5, path=path, noun="orbits")
                origin = {"orbit": row + 1, "period": float(file["states/period"][row])}
            elif u.ndim == 3:
                times = file[str(u.dims[0])].values
                # Half an interval beyond the record, no sample is nearest to the time. A single one is it at any time.
                interval = np.inf
                if len(times) > 1:
                    interval = float(times[1] - times[0])
                row = _row(times, time, reach=0.5 * interval, path=path, noun="samples in s")
                origin = {"time": float(times[row]), "case": file.attrs.get("case")}
            # Values are read when they are used: of all states only this one is.
            if u.ndim == 3:
                u = u[row]
                v = v[row]
            if u.ndim != 2 or v.shape != u.shape or cell.shape != u.shape[:1]:
                raise ValueError(f"{path} contains no state: its displacement and velocity are not over (cell, dof)")

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
        """Return displacement in m and velocity in m/s, each (cell, dof), of cells ``start`` to ``stop`` - 1."""
        inside = (self.cell > start) & (self.cell <= stop)
        rows = self.cell[inside] - 1 - start
        u, v = np.zeros((2, stop - start, self.velocity.shape[1]))
        u[rows] = self.displacement[inside]
        v[rows] = self.velocity[inside]
        return u, v

    def moving(self) -> frozenset[int]:
        """Return the cells (1-based) of which some mass moves or is displaced."""
        is_moving = np.any((self.displacement != 0) | (self.velocity != 0), axis=1)
        return frozenset(self.cell[is_moving].tolist())

    def frequency(self) -> float | None:
        """Return the frequency in rad/s of the orbit, of the run's drive or of the motion that it began with.

        None for a state alone.
        """
        if self.period:
            return 2 * np.pi / self.period
        if self.case:
            case = tomllib.loads(self.case)
            return float(case["drive"].get("frequency") or case["initial"]["frequency"])
        return None

    def largest(self, frequency: float) -> tuple[float, int]:
        """Return largest amplitude in m of a motion with ``frequency`` in rad/s in this state, and its cell, from 1.

        The amplitude of a mass is taken as |u| or |v| / frequency, the larger; 0 and cell 1 of a state without cells.
        """
        if not self.cell.size:
            return 0.0, 1
        # One of the two may vanish, at a turning point or in passing through rest.
        sizes = np.maximum(np.abs(self.displacement), np.abs(self.velocity) / frequency).max(axis=1, initial=0.0)
        return float(sizes.max()), int(self.cell[np.argmax(sizes)])


def _row(values: np.ndarray, wanted: float | None, reach: float, path: str | Path, noun: str) -> int:
    """Return the row of ``values`` (row,) nearest to ``wanted``, by default the last one.

    Raises ValueError, with a message that calls the values of the file ``path`` a ``noun``, if none is within ``reach``
    or there are none.
    """
    if not len(values):
        raise ValueError(f"{path} contains no state: it is empty")
    if wanted is None:
        return len(values) - 1
    row = int(np.argmin(np.abs(values - wanted)))
    if abs(values[row] - wanted) > reach:
        raise ValueError(f"{path} has {noun} from {values[0]:g} to {values[-1]:g}, not {wanted:g}")
    return row
