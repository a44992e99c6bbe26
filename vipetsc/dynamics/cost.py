"""What a run will cost, said before it is made: which engine makes it, how many contacts to expect, CPU time.

Models of CPU time fitted to the paper's lattices on one core, within a factor of two or so there; on another machine
both engines are off by one factor, and how they compare stays. Contacts are those of the linear wave: where waves
return to the sites, up to several times as many.
"""

from dataclasses import dataclass

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.dynamics.propagator.engine import Propagator, step_series
from vipetsc.dynamics.run import select_engine
from vipetsc.lattice import bloch, pass_bands, waves_at

# Of ts, in s: an accepted step of 8vr, a mass in it; steps that the top band needs; steps that an episode costs.
STEP, MASS, RESOLVED, EPISODE_STEPS = 3.7e-5, 1.3e-7, 0.37, 60.0
# Of the propagator, in s: what it begins with, a linear step, a cell in it, an episode.
BEGIN, LINEAR_STEP, CELL, EPISODE = 0.06, 2e-5, 6.5e-8, 3.5e-4
# Of cells with rows of their own, in s: a number of these in a step, what it takes to make one.
OWN_NUMBER, MAKE_NUMBER = 4e-10, 7e-7


@dataclass(frozen=True)
class Cost:
    """The ``engine`` that makes a run, and a note on it; contact ``episodes``; CPU times in s.

    The ``note`` says why it is not the engine asked for, or how many cells have rows of their own.

    ``seconds`` of this engine on each of the ranks, of which ``contacts`` for the episodes; ``propagator``: those of
    the engine that takes linear steps, None where it does not suit.
    """

    engine: str
    note: str | None
    episodes: float
    seconds: float
    contacts: float
    propagator: float | None

    @property
    def faster(self) -> str:
        """Where ``ts`` is to make what the propagator could: how much faster that is, in words; else empty."""
        if self.engine != "ts" or self.propagator is None or self.seconds < 1.5 * self.propagator:
            return ""
        ratio = self.seconds / self.propagator
        return f'time.engine = "propagator" would be about {ratio:.0f} times faster'


def estimate(case: Case, ranks: int = 1) -> Cost:
    """The cost of a run of ``case`` on so many ranks; every site is taken to meet the linear wave of the drive."""
    model, engine = case.model(), case.time.engine
    kind, note = select_engine(case, model)
    episodes = expected_episodes(model)
    masses = model.chain.cells * model.chain.cell.dofs / ranks
    steps = (
        1.3 * model.samples * max(np.ceil(model.sample_interval * pass_bands(model.chain.cell)[-1].high / RESOLVED), 1)
    )
    by_ts = (steps * (STEP + MASS * masses), EPISODE_STEPS * episodes * (STEP + MASS * masses))
    linear, exact = None, (0.0, 0.0)
    if not case.petsc and Propagator.refusal(model) is None and (series := step_series(model)):
        count = model.samples * round(model.sample_interval / series.interval)
        differing, tables = series.own_rows()
        numbers = (2 * model.chain.cell.dofs) ** 2 * (2 * series.reach + 1) / ranks
        step = LINEAR_STEP + CELL * model.chain.cells / ranks + OWN_NUMBER * differing * numbers
        begin = BEGIN + MAKE_NUMBER * tables * numbers
        exact = begin + count * step, EPISODE * episodes
        linear = sum(exact)
        if differing and kind is Propagator:
            size = f"{tables} tables of {8e-6 * tables * numbers:.3g} MB on a rank"
            note = f"{differing} cells have rows of their own, {size}"
    free, contacts = by_ts if kind.name == "ts" else exact
    return Cost(kind.name, note if engine != "ts" else None, episodes, free + contacts, contacts, linear)


def expected_episodes(model: Model) -> float:
    """Contact episodes if each site meets the drive's linear wave: two a cycle while |w| is above the clearance.

    The wave's largest displacement is ``model.scale``; what it is of |w| the Bloch wave tells.
    """
    cell, drive = model.chain.cell, model.drive
    waves = waves_at(cell, drive.frequency)
    if not (waves and drive.amplitude and model.chain.sites):
        return 0.0
    shares = []
    for band, kappa, _ in waves:
        shape = bloch(cell, kappa).vectors[:, band - 1]
        shares.append(abs(shape[cell.resonator] - shape[cell.host]) / np.abs(shape).max())
    gaps = np.min(model.gaps, axis=1) if model.gaps else np.asarray(model.chain.clearances)
    z = model.scale * max(shares) / np.maximum(gaps, 1e-300)
    above = np.where(z > 1, 1 - 2 / np.pi * np.arcsin(np.sqrt(1 / np.maximum(z, 1))), 0.0)
    endless = model.end * drive.frequency / (2 * np.pi)
    return float(2 * (drive.cycles if np.isfinite(drive.duration) else endless) * above.sum())
