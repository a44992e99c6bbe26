"""Motions of a model at the samples of a record, by the engines of ``run``.

An engine begins at t = 0 and samples evenly. The samples of a record are even, too, but its drive begins at some time
between two of them. The engine therefore begins with a sample: the drive begins a fraction of an interval later, or has
begun before (``shifted``). A lattice that begins in a given motion, as one that is struck, is first followed from there
to the next sample. A contact that is closed at that sample goes on as if it had had no loss before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.case.points import PointTable
from vipetsc.case.schema import OutputTable
from vipetsc.dynamics.observers import Guard
from vipetsc.dynamics.plan import RunPlan, choose_engine
from vipetsc.dynamics.run import Simulation
from vipetsc.io.store import RunMemory
from vipetsc.lattice import NO_SITES, Chain, Drive, ToneBurst
from vipetsc.lattice.drive import COEFFICIENTS, PIECE, Pieces

# Relative tolerance of all motions: differences of runs, over 1e-6 of a coordinate, keep six digits of them. A run
# costs 1.5 times as much as at 1e-6.
RTOL = 1e-12
# A drive that begins this close to a sample, over the interval, begins with it.
ALIGNED = 1e-9
# Positions between two samples at which the largest motion is looked for. Where samples are 1/w apart, w being the
# highest frequency, the cubic between them is wrong by 3e-3 of the amplitude, and these positions miss 1e-3 more.
BETWEEN = np.arange(1, 8) / 8

State = tuple[np.ndarray, np.ndarray]
"""Displacements in m and velocities in m/s (cell, dof) of a lattice."""


class MotionError(RuntimeError):
    """A motion that could not be followed to its end."""


class RecordedMotion(NamedTuple):
    """A motion at samples.

    ``motion`` (sample, watched mass, 3): u, u', u'' in m, m/s, m/s^2. The contacts (episode,) have their ``onset`` in s
    of the record's clock, their ``site`` from 0 and their ``side``, 1 or -1. ``reached`` (site, 2) are the largest w
    and -w in m, at least 0.
    """

    motion: np.ndarray
    onset: np.ndarray
    site: np.ndarray
    side: np.ndarray
    reached: np.ndarray


@dataclass(frozen=True)
class SampledModel:
    """A ``model`` whose masses ``watched`` (mass,), from 0 and cell by cell, are sampled; ``case`` is the model's.

    Without ``touches`` no site ever closes.
    """

    case: Case
    model: Model
    watched: Sequence[int]
    touches: bool = True

    def respond(self, times: np.ndarray, begin: float, state: State | None = None) -> RecordedMotion:
        """Return motion at the even ``times`` (sample,) in s, whose drive begins at ``begin`` in s of the same clock.

        The lattice begins there too, at rest or in the motion of the model; or it is in ``state`` at the first time.
        Raises MotionError if it cannot be followed to the last time.
        """
        interval = float(times[-1] - times[0]) / (len(times) - 1)
        # The number of the sample, perhaps before the record, at which the engine begins.
        first = 0
        if state is None:
            first = int(np.floor((begin - times[0]) / interval + ALIGNED))
        if first >= len(times) - 1:
            return self._at_rest(len(times))
        zero = float(times[0] + first * interval)
        late = begin - zero
        if abs(late) < ALIGNED * interval:
            late = 0.0

        if state is None and late and self.model.initial is not None:
            opening = self._run(self.model, interval - late, 1, state)
            state = opening.displacement[-1], opening.velocity[-1]
            first += 1
            zero += interval
            late -= interval
        model = self.model
        if late:
            drives = [moved for drive in model.drives for moved in shifted(drive, late)]
            model = replace(model, drives=tuple(drives))
        # Sampled more often where the motion between two samples of the record would not be known.
        parts = max(int(np.ceil(fastest(model.chain) * interval)), 1)
        run = self._run(model, interval / parts, parts * (len(times) - 1 - first), state)

        motion = np.zeros((len(times), len(self.watched), 3))
        # Samples before the beginning are those of rest; those before the record's first one are left out.
        motion[max(first, 0) :] = run.motion[parts * max(-first, 0) :: parts]
        return RecordedMotion(motion, run.onset + zero, run.site, run.side, self._reached(run, interval / parts))

    def _at_rest(self, samples: int) -> RecordedMotion:
        """Return the motion at so many ``samples`` before anything begins."""
        none = np.zeros(0, int)
        return RecordedMotion(
            motion=np.zeros((samples, len(self.watched), 3)),
            onset=np.zeros(0),
            site=none,
            side=none,
            reached=np.zeros((len(self.model.chain.sites), 2)),
        )

    def _run(self, model: Model, interval: float, count: int, state: State | None) -> "_Run":
        """Follow ``model`` over ``count`` intervals of so many s, from ``state`` on or as the model begins."""
        if not self.touches:
            model = replace(model, chain=replace(model.chain, sites=NO_SITES))
        atol = tuple(RTOL / model.rtol * value for value in model.atol)
        model = replace(model, sample_interval=interval, end=count * interval, rtol=RTOL, atol=(atol[0], atol[1]))

        dofs = model.chain.cell.dofs
        points = [PointTable(name=f"mass{mass}", cell=mass // dofs + 1, mass=mass % dofs + 1) for mass in self.watched]
        # The propagator where it applies, whatever engine the case has for its own run: steps of ts change with the
        # parameters, and so do its errors.
        time = self.case.time.model_copy(update={"engine": "propagator"})
        case = self.case.model_copy(update={"output": OutputTable(points=points), "time": time})
        memory = RunMemory(MPI.COMM_SELF)
        plan = RunPlan(case, model, choose_engine(case, model))
        result = Simulation(plan, stop=None, watching=[Guard], state=state).make(memory)
        if not result.complete:
            raise MotionError(result.sentence)

        motion = [memory.values(f"points/{name}") for name in ("displacement", "velocity", "acceleration")]
        return _Run(
            displacement=memory.values("displacement"),
            velocity=memory.values("velocity"),
            motion=np.stack(motion, axis=2),
            onset=memory.values("impacts/onset"),
            site=memory.values("impacts/site") - 1,
            side=memory.values("impacts/side"),
        )

    def _reached(self, run: "_Run", interval: float) -> np.ndarray:
        """Return the largest w and -w (site, 2) of a ``run``, at its samples and between them."""
        chain = self.model.chain
        reached = np.zeros((len(chain.sites), 2))
        s = BETWEEN[:, None]
        for number, site in enumerate(chain.sites):
            w = site.pair.relative(run.displacement, site.cell)
            rate = interval * site.pair.relative(run.velocity, site.cell)

            # Hermite's cubic through both ends of each interval.
            between = (1 - s) ** 2 * ((1 + 2 * s) * w[:-1] + s * rate[:-1])
            between += s**2 * ((3 - 2 * s) * w[1:] - (1 - s) * rate[1:])
            both = np.concatenate([w, between.ravel()])
            reached[number] = np.maximum([both.max(), -both.min()], 0.0)
        return reached


class _Run(NamedTuple):
    """What is taken of a run: fields (sample, cell, dof), ``motion`` (sample, watched mass, 3), contacts (episode,)."""

    displacement: np.ndarray
    velocity: np.ndarray
    motion: np.ndarray
    onset: np.ndarray
    site: np.ndarray
    side: np.ndarray


def shifted(drive: Drive, late: float) -> list[Drive]:
    """Return drives that together are ``drive`` as if it began ``late`` s later, or earlier if negative.

    A tone burst, which begins at t = 0, becomes its three sines.
    """
    wave = drive.waveform
    if isinstance(wave, Pieces):
        tables = [wave.table.copy()]
    else:
        tables = [_sine(wave, factor, weight) for factor, weight in _sines(wave)]

    drives = []
    for table in tables:
        table["start"] += late
        pieces = Pieces.of(1.0, wave.frequency, wave.duration + late, table)
        drives.append(replace(drive, waveform=pieces))
    return drives


def _sines(burst: ToneBurst) -> list[tuple[float, float]]:
    """Return the sines whose sum is [1 - cos(Om t/Nc)] sin(Om t): their frequency over Om, their weight."""
    return [(1.0, 1.0), (1 + 1 / burst.cycles, -0.5), (1 - 1 / burst.cycles, -0.5)]


def _sine(burst: ToneBurst, factor: float, weight: float) -> np.ndarray:
    """Return the piece (1,) of one sine of a ``burst``."""
    table = np.zeros(1, PIECE)
    table[COEFFICIENTS[0]] = weight * burst.window_amplitude
    table["frequency"] = factor * burst.frequency
    return table


def fastest(chain: Chain) -> float:
    """Return an upper bound in rad/s of the frequencies of the lattice without contacts."""
    # No eigenvalue of a symmetric matrix exceeds the largest sum of magnitudes in a row (Gershgorin). The matrix is
    # K_ij/(m_i m_j)^(1/2), whose eigenvalues are the squared frequencies.
    roots = 1 / np.sqrt(chain.masses())
    sums = roots * (abs(chain.stiffness_matrix()) @ roots)
    return float(np.sqrt(sums.max(initial=0.0)))
