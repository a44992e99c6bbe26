"""Contacts that graze in an orbit: they reach their clearance, or part from a pressed stop, with no speed."""

import numpy as np

from vipetsc.modes.system import System

# A contact grazes if the largest value of its gap is within this fraction of the clearance of zero. The parabola below
# errs by less: through 2000 samples of a quarter of the period by 1e-8 of a harmonic of order 30, and by 1e-6 of one of
# order 100.
TOUCH = 1e-5


def grazing_contacts(system: System, u: np.ndarray) -> list[int]:
    """The numbers, from 1, of contacts that graze along displacements ``u`` (samples, n) in m at equal times.

    At each local maximum among the samples a parabola through it and its two neighbours gives the largest value.
    """
    # The gap is positive where a contact is closed; its negative, of a contact pressed at rest, where it is open.
    beyond = np.where(system.is_pressed, -1.0, 1.0) * system.gaps(u)
    clearances = np.abs(system.clearances_at(u @ system.contact_rows.T)).min(axis=0)
    numbers = []
    for contact, (values, clearance) in enumerate(zip(beyond.T, clearances, strict=True)):
        # The motion has only been on a side without a stop.
        if not np.isfinite(clearance):
            continue
        # While w is on a side without a stop its gap is -inf, of which no parabola can be formed.
        values = np.maximum(values, -1e3 * clearance)
        peaks = [values[0], values[-1]]
        is_peak = (values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])
        for i in np.flatnonzero(is_peak) + 1:
            before, at, after = values[i - 1 : i + 2]
            bend = before - 2 * at + after
            peaks.append(at - (after - before) ** 2 / (8 * bend) if bend < 0 else at)
        if np.min(np.abs(peaks)) <= TOUCH * clearance:
            numbers.append(contact + 1)
    return numbers
