"""Curves as all pictures draw them: a line in its look, the area of a band around it, and which states are stable.

Looks of curves by what they show are in ``style.CURVES``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cbook import contiguous_regions

# Crosses differ from all marks of special points, and from lines of any dashes in greyscale print.
CROSSES: dict[str, Any] = {"marker": "x", "ms": 3.0, "mew": 0.5, "ls": "none"}
UNDECIDED = "undecided"
SPACING = 0.04  # of crosses, in diagonals of their axes: states may lie so close that their crosses were a broad line
STABLE = 1.3  # width in points of a curve of states where these are stable
THIN: dict[str, Any] = {"lw": 0.5, "ls": "--"}  # the line through all states


@dataclass(frozen=True)
class Series:
    """A curve of ``values`` (point,) over ``x`` (point,).

    Attributes
    ----------
    look
        Properties of the line by matplotlib's names; the colour is that of all parts.
    label
        Text in the legend.
    band
        Ends (point,) of an area around the curve, or of bars at the points of a curve without a line; ``band_label``
        is its text in the legend.
    unstable
        Number (point,) of growing perturbations of each state; -1 where undecided. A thin line then goes through all
        states, which differs from the look by ``thin``; the curve itself is where they are stable, and crosses are
        where this is undecided.
    """

    x: np.ndarray
    values: np.ndarray
    look: Mapping[str, Any]
    label: str | None = None
    band: tuple[np.ndarray, np.ndarray] | None = None
    band_label: str = ""
    unstable: np.ndarray | None = None
    thin: Mapping[str, Any] = field(default_factory=dict)

    def draw(self, axes: Axes) -> None:
        """Draw the curve in ``axes``."""
        values = self.values
        look = dict(self.look)
        if self.unstable is not None:
            look = {"lw": STABLE, **look}
            axes.plot(self.x, values, **{**look, **THIN, **self.thin})
            values = np.where(self.unstable == 0, values, np.nan)
        axes.plot(self.x, values, label=self.label, **look)

        if self.band is not None:
            self._draw_band(axes, *self.band)
        if self.unstable is not None:
            self._draw_undecided(axes, self.unstable < 0)

    def _draw_band(self, axes: Axes, low: np.ndarray, high: np.ndarray) -> None:
        """Draw an area between ``low`` and ``high`` (point,), or a bar at each point where no line joins them."""
        colour = self.look["color"]
        if self.look.get("ls") == "":
            axes.vlines(self.x, low, high, color=colour, lw=2.5, alpha=0.35, label=self.band_label)
        else:
            axes.fill_between(self.x, low, high, color=colour, alpha=0.25, lw=0, label=self.band_label)

    def _draw_undecided(self, axes: Axes, undecided: np.ndarray) -> None:
        """Draw crosses where the stability of states is ``undecided`` (point,).

        The first crosses in ``axes`` stand in a legend for all of them, as ``UNDECIDED``.
        """
        for start, stop in contiguous_regions(undecided):
            # Matplotlib leaves out all marks of a part without length, as one state is.
            spacing = None
            if stop - start > 2:
                spacing = SPACING
            label = None
            if all(line.get_label() != UNDECIDED for line in axes.lines):
                label = UNDECIDED
            look = {"color": self.look["color"], "markevery": spacing, "label": label}
            axes.plot(self.x[start:stop], self.values[start:stop], **look, **CROSSES)
