"""What is written down of an orbit's contacts, from which ``tangent_kernels`` moves the tangent later."""

from typing import NamedTuple

import numpy as np

from vipetsc.compiled import njit

ROW = np.dtype(
    [(name, float) for name in ("begin", "position", "length", "approach", "rate", "acceleration")]
    + [(name, np.int64) for name in ("kind", "site", "mode", "onset")]
)
"""A closed site in a substep: the step's begin in s; position and length as shares of the step; w'_minus; w' in m/s and
w'' in m/s^2 at its beginning; kind of nodes; the site in its cluster; its mode; whether the contact begins there."""


class Tape(NamedTuple):
    """Substeps taken while contacts were closed: ``rows`` (cluster, row) of dtype ``ROW``.

    ``motion`` (cluster, row, 2, node) holds w in m and w' in m/s at their nodes; ``used`` (cluster,) rows were needed.
    """

    rows: np.ndarray
    motion: np.ndarray
    used: np.ndarray


def create_tape(clusters: int, rows: int, nodes: int = 0) -> Tape:
    """An empty tape; one without ``rows`` takes nothing down."""
    return Tape(np.zeros((clusters, rows), ROW), np.zeros((clusters, rows, 2, nodes)), np.zeros(clusters, np.int64))


@njit(error_model="numpy")
def select_tape(tape: Tape, c: int) -> Tape:
    """The tape of cluster ``c``; one without rows serves all."""
    if tape.rows.shape[1] == 0:
        return tape
    return Tape(tape.rows[c : c + 1], tape.motion[c : c + 1], tape.used[c : c + 1])
