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
from vipetsc.figures.frequency_energy import MARKS, backbone, line
from vipetsc.io.netcdf import open_netcdf
from vipetsc.lattice import pass_bands

COLOURS = style.BLUE, style.VERMILION, style.GREEN, style.PURPLE, style.ORANGE
SMALLEST = 1e-12  # of the largest displacement, that the shape's axis shows
NARROW = 3.0  # ratio of the energies' ends below which the axis is linear


def branches(paths: Sequence[Path]) -> Figure:
    """The figure of the branches in ``paths``: of shot orbits (``backbone``), or of condensed motions."""
    condensed = []
    for path in paths:
        with open_netcdf(path, "branch") as file:
            if "states/number" in file and "harmonics" in file:
                names = np.array(file["kind"].attrs["flag_meanings"].split())
                condensed.append(file.load().assign(kind=("point", names[file["kind"].values])))
    return breathers(condensed) if condensed else backbone(paths)


def breathers(branches: Sequence[xr.Dataset]) -> Figure:
    """Frequency over energy, elongation at phase 0 over energy, stored motions over the cells; a row a branch."""
    figure = style.new_figure(style.PAGE, 2.5 * len(branches))
    for row, branch in zip(figure.subplots(len(branches), 3, squeeze=False), branches, strict=True):
        case = NnmCase.from_toml(branch.attrs["case"])
        frequency_energy(row[0], branch, case)
        amplitude(row[1], branch)
        shape(row[2], branch, lattice=case.nnm.system == "condensed")
        for axes in row[:2]:
            energy = branch["energy"].values
            if np.ptp(energy) and energy.max() > NARROW * energy.min():
                axes.set(xscale="log")
                axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if energy.max() > 30 * energy.min() else (1, 2, 5)))
                axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
                axes.xaxis.set_minor_formatter(NullFormatter())
            axes.set_xlabel("energy (J)")
        row[0].set_title(branch.attrs["name"])
    return figure


def frequency_energy(axes: Axes, branch: xr.Dataset, case: NnmCase) -> None:
    """Frequency over energy with its stability and the folds; pass bands shaded."""
    energy, frequency = branch["energy"].values, branch["frequency"].values
    line(axes, branch, 1.0)
    if len(energy) == 1:
        axes.plot(energy, frequency, ".", color=style.BLACK)
    for kind, (mark, label) in MARKS.items():
        at = branch["kind"].values == kind
        if at.any():
            axes.plot(energy[at], frequency[at], mark, label=label, ms=3, mfc="white", mec=style.BLACK, mew=0.6)
    for x, period, colour in zip(branch["states/energy"].values, branch["states/period"].values, COLOURS, strict=False):
        axes.plot(x, 1 / period, "x", color=colour, ms=5, mew=1.2)
    if case.nnm.system == "condensed":
        limits = axes.get_ylim()
        for band in pass_bands(case.lattice.unit_cell()):
            axes.axhspan(band.low / (2 * np.pi), band.high / (2 * np.pi), color=style.PALE, lw=0, zorder=0)
        axes.set_ylim(limits)
    axes.set_ylabel("frequency (Hz)")
    axes.legend(fontsize=5.5)


def amplitude(axes: Axes, branch: xr.Dataset) -> None:
    """Elongation of every place at phase 0 over energy, in mm."""
    for place, values, colour in zip(branch["place"].values, branch["elongation"].values.T, COLOURS, strict=False):
        axes.plot(branch["energy"].values, 1e3 * values, color=colour, lw=1.0, label=f"place {place}")
    axes.set_ylabel("elongation at rest (mm)")
    if branch.sizes["place"] > 1:
        axes.legend(fontsize=5.5)


def shape(axes: Axes, branch: xr.Dataset, lattice: bool) -> None:
    """Largest displacement in every cell at phase 0, over the largest of all; of every mass if there is no lattice."""
    u = np.abs(branch["states/displacement"].values)
    x, size = (branch["states/cell"].values, u.max(axis=2)) if lattice else (branch["states/dof"].values, u[:, 0])
    for values, period, colour in zip(size, branch["states/period"].values, COLOURS, strict=False):
        share = np.where(values > SMALLEST * values.max(), values / values.max(), np.nan)
        axes.semilogy(x, share, ".-", color=colour, ms=3, lw=0.8, label=f"{1 / period:.4g} Hz")
    axes.set(xlabel="cell" if lattice else "mass", ylabel="displacement / largest", ylim=(SMALLEST, 3))
    axes.legend(fontsize=5.5)
