"""Cost of a run, estimated before it begins: CPU time, and the expected number of contacts.

The models of CPU time are fitted to the paper's lattices on one core, to about a factor of two. On another machine both
engines take longer or shorter by about one factor, so that their ratio remains. The contacts are those of the linear
wave on its first way along the lattice; if waves return to the sites, there are up to several times as many.
"""

import numpy as np

from vipetsc.case import Model
from vipetsc.case.wave_at_sites import wave_over_clearance
from vipetsc.dynamics.propagator.step_choice import RESOLVED, spring_cost, step_seconds, step_series
from vipetsc.lattice import pass_bands

# Further steps of ts that an episode costs.
EPISODE_STEPS = 60.0
# Steps of ts where each sample must be the end of one, over those that its tolerance alone needs.
SAMPLED_STEPS = 1.3
# Times in s of the propagator: to begin, for a linear step, for a cell in it, for an episode.
BEGIN = 0.06
LINEAR_STEP = 2e-5
CELL = 6.5e-8
EPISODE = 3.5e-4
# Time in s of the propagator for each two masses of a cell: strips of 64 rows take 1.8 s, of 8 rows 0.13 s.
WIDTH = 4.2e-4
# Times in s of cells with separate rows: for each number in these rows in a step, and to make one of these numbers.
OWN_NUMBER = 4e-10
MAKE_NUMBER = 7e-7
# Episodes over those of the linear wave alone: impacts make the resonators move on. They are 1.6 to 2.2 in the shipped
# cases with bursts.
MOVING_ON = 2.0


def runge_kutta_seconds(model: Model) -> float:
    """Return CPU time in s of ``ts`` for ``model`` on one rank."""
    step = step_seconds(model.chain.cells * model.chain.cell.dofs)
    steps_per_sample = max(np.ceil(model.sample_interval * pass_bands(model.chain.cell)[-1].high / RESOLVED), 1)
    steps = SAMPLED_STEPS * model.samples * steps_per_sample
    return float((steps + EPISODE_STEPS * expected_episodes(model)) * step)


def propagator_seconds(model: Model) -> float:
    """Return CPU time in s of the propagator for ``model``, which it must suit, on one rank."""
    series = step_series(model)
    assert series is not None
    steps = model.samples * round(model.sample_interval / series.interval)
    own_cells, own_tables = series.own_rows()
    numbers = (2 * model.chain.cell.dofs) ** 2 * (2 * series.reach + 1)
    step = LINEAR_STEP + CELL * model.chain.cells + OWN_NUMBER * own_cells * numbers
    step += 1e-6 * spring_cost(model.chain, series.reach)  # which is in us
    begin = BEGIN + WIDTH * model.chain.cell.dofs**2 + MAKE_NUMBER * own_tables * numbers
    return begin + steps * step + EPISODE * expected_episodes(model)


def expected_episodes(model: Model) -> float:
    """Return the contact episodes if each site meets the drive's linear wave alone.

    These are one a cycle at each stop that |w| goes beyond. Impacts make the resonators move on, so that there are
    about ``MOVING_ON`` times as many.
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
