"""The driven wave in figures of wavenumber scattering: its band and wavenumber, and the bins that are shown for it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vipetsc.case import Case
from vipetsc.figures.sweep_members import DrivenWave, in_pi
from vipetsc.figures.wavenumber_bins import shown_bins


def test_bins_shown_at_the_papers_wavenumber():
    assert [b + 1 for b in shown_bins(5 * np.pi / 9, 12)] == [1, 3, 5, 7, 8, 10, 12]


@given(st.floats(1e-3, 1.0), st.integers(1, 24), st.integers(1, 9))
def test_bins_shown_hold_the_driven_ones(part, count, shown):
    """The bin of the driven wavenumber and a neighbour are among those shown, which are in order and differ.

    If one bin is shown, or there is one alone, it is the driven one.
    """
    bins = shown_bins(part * np.pi, count, shown)

    assert len(bins) == min(shown, count)
    assert bins == sorted(set(bins))
    assert bins[0] >= 0
    assert bins[-1] < count

    # Rounding decides close to a border, for which there is the test below.
    assume(abs(part * count - round(part * count)) > 1e-6 or part == 1.0)
    own = min(int(part * count), count - 1)
    assert own in bins
    if min(shown, count) > 1:
        assert own - 1 in bins or own + 1 in bins


def test_wavenumbers_in_pi():
    assert [in_pi(x * np.pi) for x in (5 / 9, 1 / 3, 1, 2, 0.1234567)] == ["5π/9", "π/3", "π", "2π", "0.123π"]


def test_a_drive_in_a_gap_has_no_wave():
    """The wave of a drive in a gap has the band 0; one in a band has band and wavenumber."""
    in_gap = {"lattice": {"preset": "diatomic", "cells": 20}, "drive": {"frequency": 600.0}, "time": {"end": 0.1}}
    assert DrivenWave.of(Case.from_table(in_gap)).band == 0

    driven = DrivenWave.of(
        Case.from_table({"lattice": {"preset": "diatomic"}, "drive": {"band": 2, "wavenumber": "5pi/9", "cycles": 6}})
    )
    assert driven.band == 2
    assert driven.wavenumber == pytest.approx(5 * np.pi / 9)
