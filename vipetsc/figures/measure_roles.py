"""Roles of the axes of a measure in its pictures: positions, curves of a panel, panels of a page, pages.

A measure has as many axes as its sweep has keys that vary independently, and perhaps one of pass bands. One or two of
them become axes of the panels. Values along the others are compared: as curves in a panel, as panels on a page, and for
those for which there is no room, on pages of their own.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

from vipetsc.figures.swept_axes import SweptAxis

MOST_CURVES = 6  # of a panel: as many as there are markers
MOST_PANELS = 16  # of a page: four by four are an inch and a half wide each
LEAST_ON_A_MAP = 3  # values of a key that is an axis of a map; two values are better compared as curves
PART = "part"  # the dimension of parts of the frequency axis


class Roles(NamedTuple):
    """Roles of the axes of a measure: ``x`` (and ``y`` of a map) become axes of the panels, the others are compared.

    Each combination of the values of ``curves`` is a curve in a panel, of ``panels`` a panel, and of ``pages`` a page.
    """

    x: SweptAxis
    y: SweptAxis | None
    curves: tuple[SweptAxis, ...]
    panels: tuple[SweptAxis, ...]
    pages: tuple[SweptAxis, ...]

    @property
    def labels(self) -> list[str]:
        """The labels of the axes of numbers: pages with the same ones can have common axes."""
        labels = []
        for axis in (self.x, self.y):
            if axis is not None and axis.is_number:
                labels.append(axis.label)
            elif axis is not None:
                labels.append("")
        return labels

    @classmethod
    def of(cls, axes: Sequence[SweptAxis]) -> Self:
        """Return the roles of ``axes``, of which there is at least one; ``y`` is None for curves.

        The longest axis with numbers, or of all axes if none has, is ``x``; the next one with numbers is ``y`` if both
        have ``LEAST_ON_A_MAP`` values. The last of the other axes become curves, unless there is a map, those before
        them panels, and the first ones pages.
        """
        # Axes of equal length stay in the order of the case: the sort is stable.
        longest_first = sorted(axes, key=lambda axis: -axis.size)
        numbers = [axis for axis in longest_first if axis.is_number]
        map_axes = [axis for axis in numbers if axis.size >= LEAST_ON_A_MAP]
        x = (numbers or longest_first)[0]
        y = None
        taken = {x.dimension}
        if len(map_axes) > 1:
            y = map_axes[1]
            taken.add(y.dimension)

        # The last axes of a case vary fastest: what they compare stands closest together. Pass bands are no curves if
        # there is anything else to compare: they differ by orders of magnitude, and members are compared band by band.
        others = [axis for axis in axes if axis.dimension not in taken]
        keys = [axis for axis in others if axis.dimension != PART]
        curves: tuple[SweptAxis, ...] = ()
        if y is None:
            curves = _last_of(keys or others, MOST_CURVES)
        taken |= {axis.dimension for axis in curves}

        others = [axis for axis in others if axis.dimension not in taken]
        panels = _last_of(others, MOST_PANELS)
        pages = tuple(others[: len(others) - len(panels)])
        return cls(x=x, y=y, curves=curves, panels=panels, pages=pages)


def _last_of(axes: Sequence[SweptAxis], most: int) -> tuple[SweptAxis, ...]:
    """Return as many of the last ``axes`` as together have at most ``most`` combinations of values."""
    count = 0
    while count < len(axes) and math.prod(axis.size for axis in axes[-count - 1 :]) <= most:
        count += 1
    return tuple(axes[len(axes) - count :])
