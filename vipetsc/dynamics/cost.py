"""Cost of a run, estimated before it begins: its engine, the expected number of contacts, CPU time.

The models of CPU time are fitted to the paper's lattices on one core, to about a factor of two. On another machine both
engines take longer or shorter by about one factor, so that their ratio remains. The contacts are those of the linear
wave on its first way along the lattice; if waves return to the sites, there are up to several times as many.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from vipetsc.case import Model
from vipetsc.case.wave_at_sites import wave_over_clearance
from vipetsc.dynamics.plan import PROPAGATOR, RunPlan
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.step_choice import refusal, spring_cost, step_series
from vipetsc.dynamics.ts_cost import RESOLVED, step_seconds
from vipetsc.lattice import pass_bands

# Further steps of ts that an episode costs.
EPISODE_STEPS = 60.0
# Steps of ts where each sample must be the end of one, over those that its tolerance alone needs.
SAMPLED_STEPS = 1.3
# Exchanges of ghosts in a step of 8vr: one for each stage and one for the contact search.
EXCHANGES = 14
# Seconds that ranks on one machine take for an exchange. With this number two ranks are a little slower than one at
# 1200 masses, as was measured.
EXCHANGE = 6.5e-6
# Times in s of the propagator: to begin, for a linear step, for a cell in it, for an episode.
BEGIN = 0.06
LINEAR_STEP = 2e-5
CELL = 6.5e-8
EPISODE = 3.5e-4
# One exchange of ghosts in a linear step, in s: two ranks are as fast as one at 300 cells.
LINEAR_EXCHANGE = 1e-5
# More ranks are worth their cores where they take less than this fraction of the time of one: two with ts from 1,590
# masses on. With 0.9 it is 1,820, with 1 it is 1,400, and the model of the time is no more exact than that.
WORTHWHILE = 0.95
# Times in s of cells with separate rows: for each number in these rows in a step, and to make one of these numbers.
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


class OwnRows(NamedTuple):
    """Cells that have separate rows in the propagator, the ``tables`` of these rows, and the numbers in a table."""

    cells: int
    tables: int
    numbers: int

    @classmethod
    def of(cls, series: StepSeries) -> Self:
        """The needs of the cells that differ in the lattice of ``series``."""
        cells, tables = series.own_rows()
        numbers = (2 * series.chain.cell.dofs) ** 2 * (2 * series.reach + 1)
        return cls(cells=cells, tables=tables, numbers=numbers)

    def describe(self, ranks: int) -> str:
        """Note on how many cells differ and on the memory of their tables, which the ranks divide among them."""
        megabytes = 8e-6 * self.tables * self.numbers / ranks
        return f"{self.cells} cells have separate rows, {self.tables} tables of {megabytes:.3g} MB per rank"


@dataclass(frozen=True)
class Cost:
    """The ``engine`` that simulates a run, and a note on it; contact ``episodes``; CPU times in s.

    The ``note`` says why it is not the requested engine, or how many cells have separate rows; None if there is nothing
    to say. ``seconds`` are those of this engine on each of the ``ranks``, of which it takes ``contacts`` for the
    episodes; ``alone`` are those on one rank, ``propagator`` those of that engine on the ``ranks``, None where it does
    not suit.
    """

    engine: str
    note: str | None
    episodes: float
    seconds: float
    contacts: float
    alone: float
    propagator: float | None
    ranks: int

    @property
    def faster(self) -> str:
        """Sentences on what would simulate the case faster: the propagator, or one rank; empty if nothing would."""
        return "; ".join(filter(None, (self._faster_engine(), self._fewer_ranks())))

    def _faster_engine(self) -> str:
        """Sentence on how much faster the propagator is where ``ts`` is to simulate what it could; else empty."""
        if self.engine != "ts" or self.propagator is None or self.seconds < 1.5 * self.propagator:
            return ""
        ratio = self.seconds / self.propagator
        return f'time.engine = "propagator" would be about {ratio:.0f} times faster'

    @property
    def one_rank_suffices(self) -> bool:
        """Whether one rank is as fast as the several ``ranks``, whose messages cost what they save."""
        return self.ranks > 1 and self.seconds >= WORTHWHILE * self.alone

    def _fewer_ranks(self) -> str:
        """Sentence that one rank is as fast as several, where it is; else empty."""
        if not self.one_rank_suffices:
            return ""
        return f"one rank would be as fast: in so short a lattice messages cost what {self.ranks} ranks save"


def estimate(plan: RunPlan, ranks: int = 1) -> Cost:
    """The cost of the run that a ``plan`` says, on so many ranks; every site is assumed to meet the drive's wave."""
    case, model, (engine, note), _ = plan
    episodes = expected_episodes(model)

    by_ts = functools.partial(_runge_kutta_seconds, model, episodes)
    exact = None
    if not case.petsc and refusal(model) is None and (series := step_series(model)):
        own_rows = OwnRows.of(series)
        exact = functools.partial(_propagator_seconds, model, series, own_rows, episodes)
        if own_rows.cells and engine == PROPAGATOR:
            note = own_rows.describe(ranks)

    cost_on: Callable[[int], Seconds] = by_ts
    if engine == PROPAGATOR and exact is not None:
        cost_on = exact
    seconds = cost_on(ranks)
    by_propagator = None
    if exact is not None:
        by_propagator = exact(ranks).total
    return Cost(
        engine=engine,
        note=note,
        episodes=episodes,
        seconds=seconds.total,
        contacts=seconds.contacts,
        alone=cost_on(1).total,
        propagator=by_propagator,
        ranks=ranks,
    )


def _runge_kutta_seconds(model: Model, episodes: float, ranks: int) -> Seconds:
    """CPU time of ``ts`` for ``model`` with so many contact episodes."""
    step = step_seconds(model.chain.cells * model.chain.cell.dofs / ranks)
    if ranks > 1:
        step += EXCHANGES * EXCHANGE
    steps_per_sample = max(np.ceil(model.sample_interval * pass_bands(model.chain.cell)[-1].high / RESOLVED), 1)
    steps = SAMPLED_STEPS * model.samples * steps_per_sample
    return Seconds(linear=steps * step, contacts=EPISODE_STEPS * episodes * step)


def _propagator_seconds(model: Model, series: StepSeries, own_rows: OwnRows, episodes: float, ranks: int) -> Seconds:
    """CPU time of the propagator for ``model`` with so many contact episodes."""
    steps = model.samples * round(model.sample_interval / series.interval)
    numbers = own_rows.numbers / ranks
    step = LINEAR_STEP + CELL * model.chain.cells / ranks + OWN_NUMBER * own_rows.cells * numbers
    step += 1e-6 * spring_cost(model.chain, series.reach)  # which is in us
    if ranks > 1:
        step += LINEAR_EXCHANGE
    begin = BEGIN + MAKE_NUMBER * own_rows.tables * numbers
    return Seconds(linear=begin + steps * step, contacts=EPISODE * episodes)


def expected_episodes(model: Model) -> float:
    """Return the contact episodes if each site meets the drive's linear wave alone.

    These are one a cycle at each stop that |w| goes beyond. Impacts make the resonators move on, so that there are up
    to several times as many.
    """
    drive = model.drive
    if not model.chain.sites:
        return 0.0
    z = wave_over_clearance(model)

    # A sine that does not end is above a clearance for the whole run, or never.
    if drive.repeats:
        cycles = model.end * drive.frequency / (2 * np.pi)
        return float(cycles * np.count_nonzero(z > 1))

    # The envelope of a burst is sin^2, above 1/z in this fraction of its time.
    above = np.where(z > 1, 1 - 2 / np.pi * np.arcsin(np.sqrt(1 / np.maximum(z, 1))), 0.0)
    return float(drive.cycles * above.sum())
