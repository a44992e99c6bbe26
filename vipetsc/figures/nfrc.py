"""Nonlinear frequency-response curves: displacement, stability, folds, slow sweeps, and fractions of the energy."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.nfrc import NfrcCase
from vipetsc.figures import panels, style
from vipetsc.io.netcdf import open_netcdf

ENERGIES = {
    "transmitted": ("T, transmitted", style.BLUE),
    "reflected": ("R, reflected", style.SKY),
    "upper": ("U, other harmonics", style.VERMILION),
    "lost": ("L, dissipated in contacts", style.ORANGE),
}
FOLD = 1  # of the variable ``kind``


def frequency_response(paths: Sequence[Path]) -> Figure:
    """Draw displacement over amplitude or frequency, and below it fractions of the energy; a column for each file."""
    branches = []
    for path in paths:
        with open_netcdf(path, "branch", ("share", "unstable", "over")) as file:
            branches.append(file.load())

    # A steady state that takes up no energy, in a finite lattice without losses, has nothing to divide by.
    has_energies = any(np.isfinite(branch["share"].values).any() for branch in branches)
    rows = 2 if has_energies else 1
    width = style.COLUMN if len(branches) == 1 else style.PAGE
    figure = style.new_figure(width, 2.3 * rows)
    columns = figure.subplots(rows, len(branches), sharex="col", squeeze=False).T

    for column, branch in zip(columns, branches, strict=True):
        _draw_displacement(column[0], branch)
        if has_energies:
            _draw_energies(column[1], branch)
        column[-1].set_xlabel(_parameter_label(branch))
        column[0].set_title(str(branch.attrs["name"]))
    if rows * len(branches) > 1:
        panels.label_panels(columns.T)
    return figure


def _parameter_label(branch: xr.Dataset) -> str:
    """Return what the horizontal axis shows, with its unit."""
    if branch.attrs["over"] == "frequency":
        return "frequency (rad/s)"
    if NfrcCase.of(branch).nfrc.source == "wave":
        return "amplitude of the wave / clearance"
    return "amplitude (N)"


def _parameter(branch: xr.Dataset) -> np.ndarray:
    values: np.ndarray = branch[str(branch.attrs["over"])].values
    return values


def _draw_displacement(axes: Axes, branch: xr.Dataset) -> None:
    """Draw the first site: stable states as a line, unstable ones dashed, slow sweeps broad; thin lines for others."""
    parameter = _parameter(branch)
    stable = branch["unstable"].values == 0
    relative = branch["largest"].values / branch["clearance"].values  # (point, site)
    size = relative[:, 0]

    for number, other in enumerate(relative.T[1:]):
        axes.plot(parameter, other, color=style.GREY, lw=0.6, label=None if number else "other sites")

    # Sweeps lie beneath the branch, the one down narrower, so that both are seen where they coincide.
    for name, colour, width in (("up", style.GREEN, 6.0), ("down", style.PURPLE, 3.0)):
        points = branch[f"{name}_point"].values
        if points.size > 1:
            look = {"color": colour, "lw": width, "alpha": 0.35, "solid_capstyle": "butt"}
            axes.plot(parameter[points], size[points], label=f"sweep {name}", **look)

    stable_label = "stable" if stable.any() else None
    axes.plot(parameter, np.where(stable, size, np.nan), color=style.BLACK, lw=1.3, label=stable_label)
    if not stable.all():
        # With the stable points next to them, so that the dashed line meets the full one.
        after = np.insert(~stable[:-1], 0, False)
        before = np.append(~stable[1:], False)
        dashed = np.where(~stable | before | after, size, np.nan)
        axes.plot(parameter, dashed, color=style.BLACK, lw=0.9, ls="--", label="unstable")

    folds = np.nonzero(branch["kind"].values == FOLD)[0]
    if folds.size:
        look = {"ms": 3.5, "mfc": "white", "mec": style.VERMILION, "ls": "none"}
        axes.plot(parameter[folds], size[folds], "o", label="fold", **look)
    axes.set_ylabel("largest |w| / clearance")
    axes.legend(fontsize=6, loc="best")


def _draw_energies(axes: Axes, branch: xr.Dataset) -> None:
    """Draw T, R, U and L over the parameter; unstable states thin."""
    parameter = _parameter(branch)
    stable = branch["unstable"].values == 0
    for i, name in enumerate(branch["way"].values.astype(str)):
        label, colour = ENERGIES[name]
        fraction = branch["share"].values[:, i]
        # Of a finite lattice only the losses are computed: no wave leaves it.
        if np.isfinite(fraction).any():
            axes.plot(parameter, fraction, color=colour, lw=0.6, ls="--")
            axes.plot(parameter, np.where(stable, fraction, np.nan), color=colour, lw=1.4, label=label)

    axes.set(ylabel="fraction of the energy", ylim=(-0.02, 1.04))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=6, loc="best")
