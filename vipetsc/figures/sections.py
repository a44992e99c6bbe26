"""Poincare sections of a driven run, and the bifurcation diagram of a sweep: states once a period of the drive."""

import tomllib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.page import Page
from vipetsc.figures.style import Drawing, NoPicture
from vipetsc.figures.sweep_members import MemberRun, Sweeps
from vipetsc.figures.swept_axes import SweptAxis, SweptKey
from vipetsc.io.read import whole_members
from vipetsc.wording import key_name, with_unit

# The first half of a run is taken for its transient: what it has left at the end can be seen by a longer run.
TRANSIENT = 0.5
LEAST_PERIODS = 4  # after the transient: fewer do not show whether a motion repeats
MOST_POINTS = 4  # panels of a page; a note says that there are more
# How far from a whole number of samples a period may be: sections of 1,000 periods then drift by a hundredth of one.
WHOLE = 1e-5


class PeriodicStates(NamedTuple):
    """States of a point once a period, after the transient: ``displacement`` in m and ``velocity`` in m/s (period,)."""

    point: str
    displacement: np.ndarray
    velocity: np.ndarray


def sections_of(run: xr.Dataset) -> list[PeriodicStates]:
    """Return the sections of all named points of a ``run``; raise NoPicture where it has none."""
    if "points/displacement" not in run:
        raise NoPicture("needs named points, which the case has not ([output] points)")
    drive = Case.of(run).model().drive
    time = run["time"].values
    samples = 2 * np.pi / drive.frequency / (time[1] - time[0])
    every = round(samples)
    if abs(samples - every) > WHOLE * samples:
        raise NoPicture(f"a period of the drive has {samples:.5g} samples; set time.samples_per_period")

    # Counted from the end, so that a ramp of the drive at the beginning has no part in it.
    count = int((1 - TRANSIENT) * (len(time) - 1)) // every
    if count < LEAST_PERIODS:
        raise NoPicture(f"{count} periods are left after half the run; {LEAST_PERIODS} are needed: raise time.end")
    last = (len(time) - 1) // every * every
    rows = last - every * np.arange(count)[::-1]
    return [
        PeriodicStates(str(point), run["points/displacement"].values[rows, i], run["points/velocity"].values[rows, i])
        for i, point in enumerate(run["point"].values)
    ]


def poincare(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw velocity over displacement of each named point at the beginning of each period of the drive."""
    sections = sections_of(run)
    shown = sections[:MOST_POINTS]
    page = Page.of(columns=len(shown), height=2.6)
    for axes, section in zip(page.panels, shown, strict=True):
        axes.plot(section.displacement, section.velocity, ".", color=style.BLUE, ms=2.5, mew=0)
        axes.set(title=f"{section.point}: {len(section.velocity)} periods", xlabel="Displacement (m)")
    page.panels[0].set_ylabel("Velocity (m/s)")
    if len(sections) > len(shown):
        style.add_note(page.figure, f"the first {len(shown)} of {len(sections)} points")
    return page.lettered()


class SweptStates(NamedTuple):
    """Members of one sweep along its axis ``key``: values of it (dot,) and displacements (dot,) in m by point.

    ``exponents`` (value of the axis,) in 1/s are the members' largest Lyapunov exponents, NaN where there is none.
    """

    key: SweptKey
    direction: str
    values: np.ndarray
    displacement: dict[str, np.ndarray]
    exponents: np.ndarray


# Looks of the members of a sweep by the order in which they follow one another. What goes down is drawn first and
# larger, so that both are seen where they coincide.
LOOKS = {
    "down": {"ms": 3.2, "label": "down", **style.CURVES["follows down"]},
    "none": {"ms": 1.6, "label": "each from rest", **style.CURVES["follows none"]},
    "up": {"ms": 1.6, "label": "up", **style.CURVES["follows up"]},
}


def bifurcation(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer the displacement of each named point once a period over the swept key, of all sweeps over that key."""
    branches: dict[str, list[SweptStates]] = {}
    for ensemble in sweeps:
        branch = _branch_of(ensemble, sweeps)
        if branch is not None:
            branches.setdefault(branch.key.path, []).append(branch)
    for path, along in branches.items():
        yield Drawing("" if len(branches) == 1 else path, lambda along=along: _draw_bifurcation(along))  # type: ignore[misc]


def _branch_of(ensemble: xr.Dataset, sweeps: Sweeps) -> SweptStates | None:
    """Return the sections of the members of a sweep over one number; None if it is another, or keeps no points."""
    axes = SweptAxis.all_of(ensemble)
    if len(axes) != 1 or axes[0].first_number is None:
        return None
    values: list[np.ndarray] = []
    displacement: dict[str, list[np.ndarray]] = {}
    for member, folder in whole_members(ensemble):
        run = sweeps.files.get(folder, MemberRun.open).run
        try:
            sections = sections_of(run)
        except NoPicture:
            continue
        # The coordinate of a member is that of its place on the axis.
        value = float(member[axes[0].dimension])
        values.append(np.full(len(sections[0].displacement), value))
        for section in sections:
            displacement.setdefault(section.point, []).append(section.displacement)
    if not values:
        return None
    options = tomllib.loads(ensemble.attrs["case"])["sweep"]
    whole = {point: np.concatenate(parts) for point, parts in displacement.items()}
    exponents = np.full(ensemble.sizes[axes[0].dimension], np.nan)
    if "lyapunov" in ensemble:
        exponents = ensemble["lyapunov"].values
    return SweptStates(
        key=axes[0].first_number,
        direction=options.get("follow", "none"),
        values=np.concatenate(values),
        displacement=whole,
        exponents=exponents,
    )


def _draw_bifurcation(branches: list[SweptStates]) -> Figure:
    """Draw ``branches`` over one key, a row for each point and one for the Lyapunov exponents, if there are any."""
    points = list(branches[0].displacement)[:MOST_POINTS]
    with_exponents = any(np.isfinite(branch.exponents).any() for branch in branches)
    rows = len(points) + with_exponents
    page = Page.of(rows, width=style.PAGE, height=2.2 * rows + 0.3, sharex=True)
    if with_exponents:
        _draw_exponents(page.panels[-1], branches)
    for axes, point in zip(page.panels, points, strict=False):
        for direction, look in LOOKS.items():
            for branch in branches:
                if branch.direction == direction and point in branch.displacement:
                    drawn = branch.displacement[point]
                    axes.plot(branch.values, drawn, ls="", marker=".", mew=0, rasterized=True, **look)
        axes.set_ylabel(f"{point}: displacement once a period (m)")
    page.panels[-1].set_xlabel(with_unit(key_name(branches[0].key.path), branches[0].key.unit))
    if len(branches) > 1:
        page.panels[0].legend(loc="best", markerscale=3)
    return page.lettered()


def _draw_exponents(axes: Axes, branches: list[SweptStates]) -> None:
    """Draw the Lyapunov exponents of ``branches`` in ``axes``: above zero a motion is chaotic."""
    axes.axhline(0.0, color=style.GREY, lw=0.8)
    for direction, look in LOOKS.items():
        for branch in branches:
            if branch.direction == direction:
                axes.plot(branch.key.values, branch.exponents, color=look["color"], marker=".", ms=4)
    axes.set_ylabel("Lyapunov exponent (1/s)")
