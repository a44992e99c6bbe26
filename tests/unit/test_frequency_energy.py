"""Frequency-energy plots: the inset on grazing, its place and its range, the place of the legend, regions of orbits."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.frequency_energy import frequency_energy, portraits

POINTS = 40
GRAZING = 8
# Logarithm of the energy over its range, from 0 to 1.
PLACE = np.linspace(0.0, 1.0, POINTS)


@pytest.fixture(autouse=True)
def house_style():
    with style.rc_style():
        yield


def branch_of(frequency: np.ndarray, grazing: int = GRAZING) -> xr.Dataset:
    """Return a branch with this ``frequency`` (point,) over 1 to 100 J, in contact from the point ``grazing`` on."""
    number = np.arange(POINTS)
    columns = {
        "energy": 100.0**PLACE,
        "frequency": frequency,
        "kind": np.full(POINTS, "regular"),
        "region": 1 + (number >= grazing),
        "contacts": (number >= grazing).astype(int),
        "resonance": np.zeros(POINTS, int),
        "multiplier_max": np.ones(POINTS),
    }
    branch = xr.Dataset({name: ("point", values) for name, values in columns.items()})
    branch["multiplier_max"].attrs["unstable_beyond"] = 1.01
    return branch


def drawn(branch: xr.Dataset) -> Axes:
    """Return the axes with frequencies of a ``branch`` over the range of its energies."""
    axes = Figure(figsize=(3.4, 2.3)).subplots()
    energy = branch["energy"].values
    axes.set(xscale="log", xlim=(energy.min(), energy.max()))
    frequency_energy(axes, branch)
    axes.figure.draw_without_rendering()
    return axes


def points_within(axes: Axes, branch: xr.Dataset, box) -> int:
    """Return how many of 1000 points on the curve of a ``branch`` lie in a ``box`` on the page."""
    fine = np.linspace(0.0, 1.0, 1000)
    frequency = np.interp(fine, PLACE, branch["frequency"].values)
    points = axes.transData.transform(np.column_stack([100.0**fine, frequency]))
    return box.count_contains(points)


def test_the_inset_on_grazing_covers_nothing_of_the_branch():
    """The inset covers no point of a branch that fills the lower right corner, the place that is tried first."""
    branch = branch_of(100.0 + 50.0 * PLACE**8)
    axes = drawn(branch)
    (inset,) = axes.child_axes
    assert points_within(axes, branch, inset.get_window_extent()) == 0


@pytest.mark.parametrize("rise", [0.5, -0.4])
def test_the_inset_shows_a_tenth_of_the_frequency_beyond_grazing(rise):
    """The inset ends where the frequency has risen by a tenth, or fallen, as with a contact that is pressed at rest."""
    branch = branch_of(100.0 * (1 + rise * np.maximum(PLACE - PLACE[GRAZING], 0.0)))
    (inset,) = drawn(branch).child_axes
    shown = inset.lines[0].get_ydata()
    last = shown[-1] / 100.0
    tenth = 1.1 if rise > 0 else 1 / 1.1
    assert last == pytest.approx(tenth, rel=0.015)


def test_an_orbit_is_in_the_region_of_its_own_point():
    """The title of an orbit has the region of the orbit's point, though another point of its energy is in another."""
    branch = branch_of(100.0 + 50.0 * PLACE).assign(number=("point", np.arange(POINTS)))
    branch["energy"][30] = branch["energy"][10]
    branch["region"][20:] = 3
    circle = np.exp(2j * np.pi * np.arange(16) / 16)[None, :, None] * np.ones((1, 1, 2))
    branch["orbits/number"] = ("orbit", [30])
    branch["orbits/energy"] = ("orbit", [float(branch["energy"][30])])
    branch["orbits/displacement"] = (("orbit", "phase", "dof"), circle.real)
    branch["orbits/velocity"] = (("orbit", "phase", "dof"), circle.imag)

    part = Figure().subfigures(1, 1)
    portraits(part, branch, "e")
    assert part.axes[0].get_title().startswith("III\n")
