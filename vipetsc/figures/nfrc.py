"""Steady answers of a site over amplitude or frequency: stability, folds, both sweeps, and where the energy goes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.io.netcdf import open_netcdf

SHARES = {
    "transmitted": ("T, transmitted", style.BLUE),
    "reflected": ("R, reflected", style.SKY),
    "upper": ("U, other harmonics", style.VERMILION),
    "lost": ("L, lost in contacts", style.ORANGE),
}
SWEEPS = {"up": (style.GREEN, "sweep up", 6.0), "down": (style.PURPLE, "sweep down", 3.0)}


def answers(paths: Sequence[Path]) -> Figure:
    """Largest relative displacement and shares of the energy over the parameter; a column for each file."""
    branches = []
    for path in paths:
        with open_netcdf(path, "branch", ("share", "unstable", "over")) as file:
            branches.append(file.load())
    told = any(np.isfinite(data["share"].values).any() for data in branches)
    figure = style.new_figure(style.COLUMN if len(paths) == 1 else style.PAGE, 2.3 * (1 + told))
    columns = figure.subplots(1 + told, len(paths), sharex="col", squeeze=False).T
    for column, data in zip(columns, branches, strict=True):
        over = str(data.attrs["over"])
        p, folds = data[over].values, np.nonzero(data["kind"].values == 1)[0]
        _displacement(column[0], data, p, folds)
        if told:
            _energy(column[1], data, p)
        wave = '"wave"' in next(line for line in data.attrs["case"].splitlines() if line.startswith("source = "))
        label = "frequency [rad/s]" if over == "frequency" else "amplitude [N]"
        column[-1].set_xlabel("amplitude of the wave / clearance" if wave and over == "amplitude" else label)
        column[0].set_title(str(data.attrs["name"]), fontsize=8)
    return figure


def _displacement(axes: Axes, data: xr.Dataset, p: np.ndarray, folds: np.ndarray) -> None:
    """Of the first site: stable states as a line, unstable ones dashed, slow sweeps broad; thin lines of others."""
    stable, sizes = data["unstable"].values == 0, data["largest"].values / data["clearance"].values
    size = sizes[:, 0]
    for number, other in enumerate(sizes.T[1:]):
        axes.plot(p, other, color=style.GREY, lw=0.6, label=None if number else "other sites")
    for colour, label, width in (value for name, value in SWEEPS.items() if data[f"{name}_point"].size > 1):
        way = data["up_point" if label == "sweep up" else "down_point"].values
        axes.plot(p[way], size[way], color=colour, lw=width, alpha=0.35, label=label, solid_capstyle="butt")
    axes.plot(p, np.where(stable, size, np.nan), color=style.BLACK, lw=1.3, label="stable" if stable.any() else None)
    beside = ~stable | np.append(~stable[1:], False) | np.insert(~stable[:-1], 0, False)
    if not stable.all():
        axes.plot(p, np.where(beside, size, np.nan), color=style.BLACK, lw=0.9, ls="--", label="unstable")
    if folds.size:
        axes.plot(p[folds], size[folds], "o", ms=3.5, mfc="white", mec=style.VERMILION, label="fold", ls="none")
    axes.set_ylabel("largest |w| / clearance")
    axes.legend(fontsize=6, loc="best")


def _energy(axes: Axes, data: xr.Dataset, p: np.ndarray) -> None:
    """T, R, U and L over the parameter; unstable states thin."""
    stable = data["unstable"].values == 0
    for i, name in enumerate(data["way"].values.astype(str)):
        label, colour = SHARES[name]
        share = data["share"].values[:, i]
        if np.isfinite(share).any():  # what leaves is not told of a finite lattice
            axes.plot(p, share, color=colour, lw=0.6, ls="--")
            axes.plot(p, np.where(stable, share, np.nan), color=colour, lw=1.4, label=label)
    axes.set(ylabel="share of the energy", ylim=(-0.02, 1.04))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=6, loc="best")
