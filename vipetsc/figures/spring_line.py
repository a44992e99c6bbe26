"""A spring as a line with a zigzag, and a text next to it."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from vipetsc.figures import style

ROD = {"color": style.BLACK, "lw": 0.7}  # the look of a spring's line
DISTANCE = 0.2  # from the middle of a spring to its text, in units of the drawing
LEVEL = 0.01  # component of a unit vector up to which it counts as zero

Point = tuple[float, float]


def draw_spring(
    axes: Axes, corners: Sequence[Point], text: str, turns: int = 5, height: float = 0.13, zorder: int = 2
) -> None:
    """Draw a spring along ``corners``: a zigzag with straight leads on the longest leg, and ``text`` next to it.

    The zigzag has ``turns`` turns, ``height`` to either side.
    """
    legs = np.stack([corners[:-1], corners[1:]], axis=1)
    lengths = np.hypot(*(legs[:, 1] - legs[:, 0]).T)
    longest = int(np.argmax(lengths))
    for leg in np.delete(legs, longest, axis=0):
        axes.plot(*leg.T, zorder=2, **ROD)

    start = legs[longest, 0]
    along = legs[longest, 1] - start
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    # Straight leads of a fifth of the leg at either end; between them two turning points for each turn, at equal
    # distances, on either side of the leg alternately.
    position = np.concatenate([[0, 0.2], 0.2 + 0.6 * (np.arange(2 * turns) + 0.5) / (2 * turns), [0.8, 1]])
    swing = np.zeros(len(position))
    swing[2:-2] = height * (-1.0) ** np.arange(2 * turns)
    points = start + position[:, None] * along + swing[:, None] * across
    axes.plot(*points.T, zorder=zorder, solid_joinstyle="round", **ROD)

    _write_beside(axes, start + along / 2, across, text)


def _write_beside(axes: Axes, middle: np.ndarray, across: np.ndarray, text: str) -> None:
    """Write ``text`` next to the ``middle`` of a spring's leg: above the leg, or on the right of an upright one.

    ``across`` is a unit vector at right angles to the leg.
    """
    is_upright = abs(across[1]) < LEVEL
    points_up = across[0] > 0 if is_upright else across[1] > 0
    side = across if points_up else -across
    place = {"ha": "center", "va": "bottom"}
    # The text of an oblique leg begins, or ends, beside the leg: a text above its middle would lie on the zigzag.
    if side[0] > LEVEL:
        place["ha"] = "left"
    elif side[0] < -LEVEL:
        place["ha"] = "right"
    if is_upright:
        place["va"] = "center"
    axes.text(*(middle + DISTANCE * side), text, **place)
