"""Cost of a run, estimated before it begins: its engine, the expected number of contacts, CPU time.

The models of CPU time are fitted to the paper's lattices on one core, to about a factor of two. On another machine both
engines differ by a common factor, so that their ratio remains. The contacts are those of the linear wave; if waves
return to the sites, there are up to several times as many.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vipetsc.case import Case, Model
from vipetsc.dynamics.propagator.engine import Propagator, step_series
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.run import select_engine
from vipetsc.lattice import bloch, pass_bands, waves_at

# Of ts: seconds an accepted step of 8vr and a mass in it; radians of the top band in a step, steps an episode costs.
STEP = 3.7e-5
MASS = 1.3e-7
RESOLVED = 0.37
EPISODE_STEPS = 60.0
# Steps that end on samples, over those that are needed.
SAMPLED_STEPS = 1.3
# Of the propagator, in s: what it begins with, a linear step, a cell in it, an episode.
BEGIN = 0.06
LINEAR_STEP = 2e-5
CELL = 6.5e-8
EPISODE = 3.5e-4
# Of cells with rows of their own, in s: a number of these in a step, what it takes to make one.
OWN_NUMBER = 4e-10
MAKE_NUMBER = 7e-7


class Seconds(NamedTuple):
    """CPU time in s of an engine: without contacts, and for their episodes."""

    linear: float
    contacts: float

    @property
    def total(self) -> float:
        """Time with and without contacts together."""
        return self.linear + self.contacts


@dataclass(frozen=True)
class Cost:
    """The ``engine`` that simulates a run, and a note on it; contact ``episodes``; CPU times in s.

    The ``note`` says why it is not the requested engine, or how many cells have separate rows.

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
        """Sentence on how much faster the propagator is where ``ts`` is to simulate what it could; else empty."""
        if self.engine != "ts" or self.propagator is None or self.seconds < 1.5 * self.propagator:
            return ""
        ratio = self.seconds / self.propagator
        return f'time.engine = "propagator" would be about {ratio:.0f} times faster'


def estimate(case: Case, ranks: int = 1) -> Cost:
    """The cost of a run of ``case`` on so many ranks; every site is assumed to meet the linear wave of the drive."""
    model = case.model()
    kind, note = select_engine(case, model)
    episodes = expected_episodes(model)
    by_ts = _runge_kutta_seconds(model, episodes, ranks)
    exact = None
    if not case.petsc and Propagator.refusal(model) is None and (series := step_series(model)):
        exact, own_rows = _propagator_seconds(model, series, episodes, ranks)
        if own_rows and kind is Propagator:
            note = own_rows

    seconds = by_ts if kind.name == "ts" or exact is None else exact
    return Cost(
        engine=kind.name,
        note=note if case.time.engine != "ts" else None,
        episodes=episodes,
        seconds=seconds.total,
        contacts=seconds.contacts,
        propagator=exact.total if exact else None,
    )


def _runge_kutta_seconds(model: Model, episodes: float, ranks: int) -> Seconds:
    """CPU time of ``ts`` for ``model`` with so many contact episodes."""
    step = STEP + MASS * model.chain.cells * model.chain.cell.dofs / ranks
    steps_per_sample = max(np.ceil(model.sample_interval * pass_bands(model.chain.cell)[-1].high / RESOLVED), 1)
    return Seconds(SAMPLED_STEPS * model.samples * steps_per_sample * step, EPISODE_STEPS * episodes * step)


def _propagator_seconds(model: Model, series: StepSeries, episodes: float, ranks: int) -> tuple[Seconds, str | None]:
    """CPU time of the propagator, and a note on cells with rows of their own, if there are any."""
    steps = model.samples * round(model.sample_interval / series.interval)
    differing, tables = series.own_rows()
    numbers = (2 * model.chain.cell.dofs) ** 2 * (2 * series.reach + 1) / ranks
    step = LINEAR_STEP + CELL * model.chain.cells / ranks + OWN_NUMBER * differing * numbers
    begin = BEGIN + MAKE_NUMBER * tables * numbers
    seconds = Seconds(begin + steps * step, EPISODE * episodes)
    if not differing:
        return seconds, None
    size = f"{tables} tables of {8e-6 * tables * numbers:.3g} MB per rank"
    return seconds, f"{differing} cells have separate rows, {size}"


def expected_episodes(model: Model) -> float:
    """Contact episodes if each site meets the drive's linear wave: two a cycle while |w| is above the clearance.

    The wave's largest displacement is ``model.scale``; the ratio of |w| to it is that of the Bloch wave.
    """
    cell = model.chain.cell
    drive = model.drive
    waves = waves_at(cell, drive.frequency)
    if not (waves and drive.amplitude and model.chain.sites):
        return 0.0

    largest = 0.0
    for band, kappa, _ in waves:
        shape = bloch(cell, kappa).vectors[:, band - 1]
        largest = max(largest, abs(shape[cell.resonator] - shape[cell.host]) / np.abs(shape).max())
    gaps = np.min(model.gaps, axis=1) if model.gaps else np.asarray(model.chain.clearances)
    # Beads that touch have no clearance: any wave closes them.
    z = model.scale * largest / np.maximum(gaps, 1e-300)

    # The fraction of a burst in which its envelope sin^2 is above 1/z.
    above = np.where(z > 1, 1 - 2 / np.pi * np.arcsin(np.sqrt(1 / np.maximum(z, 1))), 0.0)
    cycles = model.end * drive.frequency / (2 * np.pi)
    if np.isfinite(drive.duration):
        cycles = drive.cycles
    return float(2 * cycles * above.sum())
