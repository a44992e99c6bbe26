"""The design of an absorbing end: computed once for all amplitudes of a burst, whether one is found or not."""

from __future__ import annotations

import pytest

from vipetsc.case import Case, CaseError, absorbing

pytestmark = pytest.mark.parallel(1)


def case(amplitude: float, reflection: float) -> Case:
    """Return the case of a lattice of 60 cells under a burst in its fourth band, with an absorbing right end."""
    return Case.from_table({
        "lattice": {"preset": "four-band", "cells": 60, "absorbing": {"end": "right", "reflection": reflection}},
        "contacts": {"sites": 0},
        "drive": {"amplitude": amplitude, "cycles": 30},
    })  # fmt: skip


@pytest.fixture
def tried(monkeypatch) -> list[float]:
    """Return a list that receives the reflected fraction of each end that is tried."""
    absorbing._first_end.cache_clear()
    fractions: list[float] = []
    original = absorbing.reflected

    def record(*arguments: object) -> float:
        fractions.append(original(*arguments))
        return fractions[-1]

    monkeypatch.setattr(absorbing, "reflected", record)
    return fractions


def test_an_end_is_designed_once_for_all_amplitudes(tried):
    """Three amplitudes of a burst have one end, found by one search up to the first end that reflects 0.1 or less."""
    ends = [case(amplitude, reflection=0.1).lattice.absorbing for amplitude in (1.0, 2.0, 30.0)]
    assert ends[0] == ends[1] == ends[2]
    assert len(tried) == 1 + sum(fraction > 0.1 for fraction in tried)


def test_that_no_end_will_do_is_found_once(tried):
    """No end is tried twice where all ends fail, although two amplitudes ask for one."""
    for amplitude in (1.0, 2.0):
        with pytest.raises(CaseError, match="is reflected, mostly slow waves"):
            case(amplitude, reflection=1e-9)
    assert len(tried) == len(set(tried))


def test_a_lattice_that_is_too_short_for_an_end_is_told_so():
    """An end may have a third of the lattice, 8 of 24 cells, and needs 10: the case is refused."""
    lattice = {"preset": "four-band", "cells": 24, "absorbing": {}}
    with pytest.raises(CaseError, match="an end has 10 cells or more, and at most a third of the lattice"):
        Case.from_table({"lattice": lattice, "contacts": {"sites": 0}})


def test_the_length_that_is_given_is_the_one_that_is_named(tried):
    """A length that the case gives is the only one tried, also where it is more than a third of the lattice."""
    lattice = {"preset": "four-band", "cells": 60, "absorbing": {"cells": 25, "reflection": 1e-9}}
    with pytest.raises(CaseError, match="no end of up to 25 cells satisfies it"):
        Case.from_table({"lattice": lattice, "contacts": {"sites": 0}})
    assert len(tried) == len(absorbing.LOSSES)
