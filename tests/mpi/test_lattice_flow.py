"""Orbits of a lattice and their tangent motions have the same bits on any number of ranks."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import on_two
from tests.models import CLEARANCE, four_band_contact
from vipetsc.case import NnmCase
from vipetsc.dynamics.propagator.tangent import TangentPropagator
from vipetsc.lattice import Chain
from vipetsc.lattice.cell import four_band
from vipetsc.modes.balance.stops import Stops
from vipetsc.modes.branches.lattices import LatticeMethod
from vipetsc.modes.branches.losses import with_lattice_loss
from vipetsc.modes.lattice.lattice_flow import LatticeFlow
from vipetsc.modes.point import Point
from vipetsc.parallel import on_root

COMM = MPI.COMM_WORLD


@pytest.mark.parallel([2, 3])
def test_losses_have_the_same_bits():
    """The energy that dashpots and contacts dissipate along an orbit does not depend on the number of ranks."""
    table = {
        "lattice": {"preset": "four-band", "cells": 18, "damping": {"mass": 0.1}},
        "contacts": {"sites": [6, 9, 10], "restitution": 0.9},
        "nnm": {"system": "chain", "start_frequency": [1600.0], "forced": [9, 1]},
    }
    case = NnmCase.from_table(table)

    def losses(comm):
        """The loss and the force of a motion in which all sites touch; it need not be periodic."""
        method = LatticeMethod(case, comm)
        x = 1e-2 * np.random.default_rng(3).standard_normal(method.system.dofs)
        point = Point(
            tangent=np.empty(0),
            index=0,
            step=0.0,
            next_step=0.0,
            kind="regular",
            x=x,
            period=2 * np.pi / 1600,
            energy=1.0,
            residual=0.0,
            episodes=0,
            closed=0.0,
            newton=0,
        )
        lossy = with_lattice_loss(method.lattice, method.dissipation, point)
        return lossy.loss, lossy.force

    together = losses(COMM)
    assert together == on_root(COMM, lambda: losses(MPI.COMM_SELF))
    assert together[0] > 0


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("restitution", [*on_two(1.0), 0.7])
def test_variations_have_the_same_bits(restitution):
    """An orbit and three tangent motions have the same bits, with clusters of sites across borders of ranks.

    18 cells are cut after cell 9 on 2 ranks, and after cells 6 and 12 on 3.
    """
    sites = (5, 8, 9, 12)
    cells = 18
    dofs = 4
    chain = Chain(four_band("calibrated"), cells, "fixed", sites, (CLEARANCE,) * len(sites))
    contact = replace(four_band_contact("hertz"), restitution=restitution)

    # Resonators move towards their stops: every site has a contact within a period.
    random = np.random.default_rng(3)
    state = 1e-5 * random.standard_normal((2, cells, dofs))
    state[0, sites, 2] += 1.6e-3
    state[1, sites, 2] += 1.0
    variations = random.standard_normal((3, 2, cells, dofs)).reshape(3, -1)

    def after_a_period(comm):
        """The state, the tangent motions and the number of closed contacts after a period."""
        flow = LatticeFlow(chain, [Stops.both(contact, clearance) for clearance in chain.clearances], comm)
        arc = flow.arc(flow.scatter(state.ravel()), 2 * np.pi / 1600)
        assert arc.episodes >= len(sites)
        end = flow.gather(arc.end)
        moved = flow.gather(arc.move(flow.scatter(variations)))
        arc.engine.destroy()
        return end, moved, arc.closed

    end, moved, closed = after_a_period(COMM)
    end_alone, moved_alone, closed_alone = on_root(COMM, lambda: after_a_period(MPI.COMM_SELF))

    assert end.tobytes() == end_alone.tobytes()
    assert moved.tobytes() == moved_alone.tobytes()
    assert closed == closed_alone > 0


@pytest.mark.parallel([2])
def test_one_rank_alone_may_look_at_an_orbit():
    """If one rank observes an orbit, all ranks stop at its samples, and the end has the bits of an unobserved orbit."""
    chain = Chain(four_band("calibrated"), 18, "fixed", (8,), (CLEARANCE,))
    flow = LatticeFlow(chain, [Stops.both(four_band_contact("hertz"), CLEARANCE)], COMM)
    start = flow.scatter(1e-5 * np.random.default_rng(3).standard_normal(2 * 18 * 4))
    seen = []
    look = None
    if COMM.rank == 0:
        look = seen.append

    def end(look):
        engine = TangentPropagator(flow._model(2 * np.pi / 1600, 5), flow.layout)
        engine.place(start, 1.0)
        cells = engine.run(5, look)
        engine.destroy()
        return cells

    looked_at = end(look)
    assert len(seen) == (5 if COMM.rank == 0 else 0)
    assert looked_at.tobytes() == end(None).tobytes()
