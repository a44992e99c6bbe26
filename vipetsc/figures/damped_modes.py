"""Damped modes: frequency and damping ratio over the energy, a column a branch."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.frequency_energy import HOLLOW, MARKS, read_branch
from vipetsc.figures.page import Page


def damped_modes(paths: Sequence[Path]) -> Figure:
    """Draw frequency and damping ratio of the branches in ``paths`` over their energies, with special points."""
    branches = [read_branch(path, ("energy", "frequency", "damping_ratio", "kind")) for path in paths]

    page = Page.of(2, len(branches), height=3.6, sharex="col")
    for column, branch in zip(page.grid.T, branches, strict=True):
        energy = branch["energy"].values
        kinds = branch["kind"].values
        for axes, name in zip(column, ("frequency", "damping_ratio"), strict=True):
            values = branch[name].values
            axes.plot(energy, values, color=style.BLACK)
            for kind, (mark, label) in MARKS.items():
                at = kinds == kind
                if at.any():
                    axes.plot(energy[at], values[at], mark, ms=3, label=label, **HOLLOW)
        # Branches begin at energies that are many decades below those at which they change.
        if energy.min() > 0 and energy.max() > 30 * energy.min():
            column[0].set_xscale("log")
        column[0].set_title(str(branch.attrs["name"]))
        column[0].set_ylabel("frequency (Hz)")
        column[1].set(xlabel="mean energy (J)", ylabel="damping ratio")
        if column[0].get_legend_handles_labels()[0]:
            column[0].legend(fontsize=6, loc="best")
    return page.lettered()
