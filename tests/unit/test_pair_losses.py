"""Losses of dashpots by pairs of forces in a substep, one coefficient at a time."""

import numpy as np
import pytest

from tests.unit.propagator_parts import mass_on_stop
from vipetsc.dynamics.propagator.losses import PairLosses, accumulate_losses
from vipetsc.dynamics.propagator.nodes import NODES, PLAIN
from vipetsc.dynamics.propagator.substeps import Substep


def test_an_impulse_of_zero_that_had_moments_still_loses_with_a_later_force():
    """The loss is impulse times kernel times first moment where an earlier force has left a moment and no impulse.

    An earlier force that changed its sign has the impulse zero and moves the mass, on which the later force works.
    """
    kernels = np.zeros((1, 2, 2))
    kernels[0, 0, 1] = 5.0
    losses = PairLosses(
        kinds=np.array([[-1, 0], [-1, -1]]),
        kernels=kernels,
        degrees=np.array([2]),
        moments=np.array([[0.0, 0.0], [0.0, 3.0]]),
        loss=np.zeros(1),
        legendre=np.zeros((2, NODES)),
        before=np.zeros((2, 2, NODES)),
    )
    cluster = mass_on_stop()
    cluster.trial.force[:] = 7.0
    accumulate_losses(losses, cluster, cluster.trial, Substep(PLAIN, 0.25))
    impulse = 7.0 * 0.25 * cluster.interval
    assert losses.loss[0] == pytest.approx(impulse * 5.0 * 3.0, rel=1e-13)
    # The moments then include the force: its impulse, and the impulse times the mean of 2 a - 1 over the first quarter
    # of the step, 0.75, where a is the fraction of the step that remains.
    assert losses.moments[0] == pytest.approx([impulse, 0.75 * impulse], rel=1e-13)
