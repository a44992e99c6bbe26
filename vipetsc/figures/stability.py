"""Curves of steady states: how pictures tell stable states from unstable ones, and from undecided ones."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cbook import contiguous_regions

# Crosses differ from all marks of special points, and from lines of any dashes in greyscale print.
CROSSES: dict[str, Any] = {"marker": "x", "ms": 3.0, "mew": 0.5, "ls": "none"}
UNDECIDED = "undecided"
SPACING = 0.04  # of crosses, in diagonals of their axes: states may lie so close that their crosses were a broad line


class StabilityLook(NamedTuple):
    """Look of a curve: ``colour``, widths in points and dashes of the line of all states and of that of stable ones."""

    colour: Any
    thin: float = 0.5
    broad: float = 1.3
    thin_dashes: Any = "--"
    broad_dashes: Any = "-"


def draw_states(
    axes: Axes,
    parameter: np.ndarray,
    values: np.ndarray,
    unstable: np.ndarray,
    look: StabilityLook,
    label: str | None = None,
) -> None:
    """Draw ``values`` (point,) over ``parameter`` (point,), ``unstable`` (point,) being the growing perturbations.

    A thin line goes through all states, a broad one with the ``label`` lies on it where they are stable, and crosses
    mark the parts of the curve whose stability is undecided (-1).
    """
    axes.plot(parameter, values, color=look.colour, lw=look.thin, ls=look.thin_dashes)
    stable = np.where(unstable == 0, values, np.nan)
    axes.plot(parameter, stable, color=look.colour, lw=look.broad, ls=look.broad_dashes, label=label)
    draw_undecided(axes, parameter, values, unstable, look.colour)


def draw_undecided(axes: Axes, parameter: np.ndarray, values: np.ndarray, unstable: np.ndarray, colour: Any) -> None:
    """Draw crosses in that ``colour`` along the parts of a curve whose stability is undecided, if it has any.

    The first crosses in ``axes`` stand in a legend for all of them, as ``UNDECIDED``.
    """
    for start, stop in contiguous_regions(unstable < 0):
        # Matplotlib leaves out all marks of a part without length, as one state is.
        spacing = None
        if stop - start > 2:
            spacing = SPACING
        label = None
        if all(line.get_label() != UNDECIDED for line in axes.lines):
            label = UNDECIDED
        look = {"color": colour, "markevery": spacing, "label": label}
        axes.plot(parameter[start:stop], values[start:stop], **look, **CROSSES)
