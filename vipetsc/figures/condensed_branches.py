"""Branches of motions condensed onto contacts: frequency and amplitude over energy, and the motion over the cells."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from vipetsc.case.nnm import NnmCase
from vipetsc.figures import style
from vipetsc.figures.branch_curves import draw_branch, draw_losses
from vipetsc.figures.frequency_energy import MARKS, read_branch
from vipetsc.figures.page import Page
from vipetsc.figures.panels import annotate_empty
from vipetsc.lattice import wave_bands

# Smallest displacement that is drawn, over the largest: localised motions decay to rounding, 1e-16.
SMALLEST = 1e-12
# Ratios of the largest to the smallest energy. Below the first an axis is linear, since a logarithmic one would have
# one label; above the second it has labels at powers of ten only, since those at 2 and 5 would touch.
NARROW = 3.0
WIDE = 30.0


def condensed_branches(paths: Sequence[Path]) -> Figure:
    """Draw frequency and elongation at phase 0 over energy, and stored motions over the cells; a row for each file.

    If one of the branches has losses, their damping is drawn as well. Raises OSError or ValueError for a file that
    holds no condensed branch.
    """
    branches = [read_branch(path, ("harmonics", "elongation", "kind")) for path in paths]

    # All rows have the panels that one of them needs, so that their axes stand below each other.
    columns = 3
    if any("damping_ratio" in branch for branch in branches):
        columns = 4
    page = Page.of(len(branches), columns, height=2.5 * len(branches))
    for (frequency, elongation, *losses, motions), branch in zip(page.grid, branches, strict=True):
        case = NnmCase.from_toml(branch.attrs["case"])
        # A user-defined system has neither cells nor pass bands.
        is_lattice = case.nnm.system == "condensed"
        _draw_frequency(frequency, branch)
        if is_lattice:
            _shade_pass_bands(frequency, case)
        frequency.legend(fontsize=5.5)
        frequency.set_title(branch.attrs["name"])

        _draw_elongation(elongation, branch)
        for axes in losses:
            draw_losses(axes, branch)
        for axes in (frequency, elongation, *losses):
            _set_energy_axis(axes, branch)

        if "states/number" not in branch:
            # Motions are stored when a branch ends: this one was interrupted.
            annotate_empty(motions, "no motions stored")
        elif is_lattice or branch.sizes["states/cell"] > 1:
            _draw_over_cells(motions, branch)
        else:
            _draw_over_masses(motions, branch)
    return page.lettered()


def _draw_frequency(axes: Axes, branch: xr.Dataset) -> None:
    """Draw frequency over energy with its stability, the special points, and crosses for the stored motions."""
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    draw_branch(axes, branch, width=1.0)
    # A curve of one point is no line.
    if len(energy) == 1:
        axes.plot(energy, frequency, ".", color=style.BLACK)

    for kind, (mark, label) in MARKS.items():
        at = branch["kind"].values == kind
        if at.any():
            axes.plot(energy[at], frequency[at], mark, label=label, ms=3, mfc="white", mec=style.BLACK, mew=0.6)

    if "states/number" in branch:
        stored = zip(branch["states/energy"].values, branch["states/period"].values, strict=True)
        for number, (state_energy, period) in enumerate(stored):
            axes.plot(state_energy, 1 / period, "x", color=style.numbered_look(number)["color"], ms=5, mew=1.2)
    axes.set_ylabel("frequency (Hz)")


def _shade_pass_bands(axes: Axes, case: NnmCase) -> None:
    """Shade the pass bands as far as they reach into the panel, whose limits stay those of the branch."""
    # A pass band far from the branch must not squeeze the curve.
    limits = axes.get_ylim()
    for band in wave_bands(case.lattice.unit_cell()):
        axes.axhspan(band.low / (2 * np.pi), band.high / (2 * np.pi), color=style.PALE, lw=0, zorder=0)
    axes.set_ylim(limits)


def _draw_elongation(axes: Axes, branch: xr.Dataset) -> None:
    """Draw the elongation in mm of every contact or spring at phase 0, where all masses are at rest, over energy."""
    energy = branch["energy"].values
    pairs = zip(branch["pair"].values, branch["elongation"].values.T, strict=True)
    for number, (pair, values) in enumerate(pairs):
        axes.plot(energy, 1e3 * values, lw=1.0, label=f"pair {pair}", **style.numbered_look(number))
    axes.set_ylabel("elongation at rest (mm)")
    if branch.sizes["pair"] > 1:
        axes.legend(fontsize=5.5)


def _set_energy_axis(axes: Axes, branch: xr.Dataset) -> None:
    """Make the axis of energy logarithmic unless it is narrow, with as many labels as there is room for."""
    energy = branch["energy"].values
    low = energy.min()
    high = energy.max()
    if high > low and high > NARROW * low:
        subdivisions: tuple[float, ...] = (1, 2, 5)
        if high > WIDE * low:
            subdivisions = (1,)
        axes.set(xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=subdivisions))
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("energy (J)")


def _draw_over_cells(axes: Axes, branch: xr.Dataset) -> None:
    """Draw the largest displacement in every cell at phase 0, over the largest of all."""
    largest = np.abs(branch["states/displacement"].values).max(axis=2)
    _draw_shapes(axes, branch["states/cell"].values, largest, branch)
    axes.set(xlabel="cell", ylabel="displacement / maximum", ylim=(SMALLEST, 3))
    axes.legend(fontsize=5.5)


def _draw_over_masses(axes: Axes, branch: xr.Dataset) -> None:
    """Draw the displacement of every mass at phase 0, over the largest of all."""
    displacement = np.abs(branch["states/displacement"].values)[:, 0]
    _draw_shapes(axes, branch["states/mass"].values, displacement, branch)
    axes.set(xlabel="mass", ylabel="displacement / maximum", ylim=(SMALLEST, 3))
    axes.legend(fontsize=5.5)


def _draw_shapes(axes: Axes, x: np.ndarray, shapes: np.ndarray, branch: xr.Dataset) -> None:
    """Draw ``shapes`` (motion, x) of the stored motions on a logarithmic axis, named by their frequencies."""
    for number, (values, period) in enumerate(zip(shapes, branch["states/period"].values, strict=True)):
        relative = values / values.max()
        visible = np.where(relative > SMALLEST, relative, np.nan)
        axes.semilogy(x, visible, marker=".", ms=3, lw=0.8, label=f"{1 / period:.4g} Hz", **style.numbered_look(number))
