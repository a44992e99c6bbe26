"""Modes whose frequency equals that of another mode, or a whole fraction of it, begin no branch."""

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import CaseError, NnmCase
from vipetsc.lattice import Contact
from vipetsc.modes.branches.follow import claim_branches, follow_all
from vipetsc.modes.shared_frequencies import Companion, companions, why_not_alone
from vipetsc.modes.system import ContactPair, SmoothSpring, System


def oscillators(*omega: float, minus: float | None = None, cubic: float = 0.0) -> System:
    """Return separate masses of 1 kg on springs, with these frequencies in rad/s, and a stop at the first one."""
    springs = [(None, i, frequency**2) for i, frequency in enumerate(omega)]
    stop = ContactPair(None, 0, 1e-3, Contact("bilinear", 1e4), clearance_minus=minus)
    smooth = [SmoothSpring.between(None, 0, cubic=cubic)] if cubic else []
    return System.assemble(np.ones(len(omega)), springs, [stop], smooth)


def test_equal_frequencies_are_companions_of_each_other():
    """Modes of equal frequency are companions of each other, with the factor 1."""
    system = oscillators(1.0, 3.0 + 1e-3, 1.0)
    assert companions(system, 0) == [Companion(1, 1)]
    assert companions(system, 1) == [Companion(0, 1)]
    assert companions(system, 2) == []
    assert "mode 1 has the frequency of mode 2" in why_not_alone(system, 0)


def test_multiples_are_companions_of_the_lower_mode_alone():
    """The mode of a multiple of a frequency is a companion of the lower mode, and not the other way round.

    Even multiples count only where the stops on both sides differ, since motions are then not symmetric.
    """
    assert companions(oscillators(1.0, 2.0, 3.0), 0) == [Companion(2, 3)]
    assert companions(oscillators(1.0, 2.0, 3.0, minus=np.inf), 0) == [Companion(1, 2), Companion(2, 3)]
    assert companions(oscillators(1.0, 2.0, 3.0), 2) == []
    assert "mode 3 has 3 times the frequency of mode 1" in why_not_alone(oscillators(1.0, 2.0, 3.0), 0)


def ring(**nnm) -> NnmCase:
    """Return the case of a ring of three cells of two masses, whose modes 2 and 3 are waves in both directions."""
    springs = [
        {"start": 1, "end": 1, "next_cell": True, "stiffness": 1000.0},
        {"start": 1, "end": 2, "stiffness": 700.0},
    ]
    table = {
        "name": "ring",
        "lattice": {
            "cells": 3,
            "ends": "periodic",
            "cell": {"masses": [1.0, 0.5], "springs": springs, "contact": [1, 2]},
        },
        "contacts": {"law": "bilinear", "stiffness": 5000.0, "sites": [2], "clearance": 1e-3},
        "nnm": {"system": "chain", "points": 2, **nnm},
    }
    return NnmCase.from_table(table)


def test_waves_around_a_ring_are_refused_before_anything_is_written(tmp_path):
    """A mode of a ring with the frequency of another one is refused by its number, and no folder is created."""
    with pytest.raises(CaseError) as refused, claim_branches(ring(modes=[2, 4]), tmp_path / "out", MPI.COMM_SELF):
        pass
    (problem,) = refused.value.problems
    assert problem.key == "nnm.modes"
    assert problem.value == [2]
    assert "mode 2 has the frequency of mode 3" in problem.remedy
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", ["shooting", "balance"])
def test_a_branch_in_memory_ends_with_the_same_reason(method):
    """A branch that is followed in memory ends with the reason for which a folder would be refused."""
    alone, shared = follow_all(ring(modes=[4, 3], method=method), None, MPI.COMM_SELF)
    assert "2 points reached" in alone.ended.sentence
    assert "mode 3 has the frequency of mode 2" in shared.ended.sentence
