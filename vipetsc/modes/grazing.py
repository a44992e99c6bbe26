"""Contacts that graze in an orbit: they reach their clearance, or part from a pressed stop, with no speed."""

import numpy as np

from vipetsc.modes.system import System

# A largest gap within this fraction of the clearance is a touch.
TOUCH = 1e-5


def grazing_contacts(system: System, u: np.ndarray) -> list[int]:
    """The numbers, from 1, of contacts that graze along displacements ``u`` (samples, n) in m at equal times.

    A parabola through each largest sample and its neighbours gives the largest value between them.
    """
    # How far each contact is beyond what it is at rest: closed, or open if it is pressed.
    beyond = np.where(system.is_pressed, -1.0, 1.0) * system.gaps(u)
    clearances = np.abs(system.clearances_at(u @ system.contact_rows.T)).min(axis=0)
    numbers = []
    for contact, (values, clearance) in enumerate(zip(beyond.T, clearances, strict=True)):
        # A side without a stop is infinitely far away.
        values = np.maximum(values, -1e3 * clearance) if np.isfinite(clearance) else np.full(len(values), -1.0)
        peaks = [values[0], values[-1]]
        is_peak = (values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])
        for i in np.flatnonzero(is_peak) + 1:
            before, at, after = values[i - 1 : i + 2]
            bend = before - 2 * at + after
            peaks.append(at - (after - before) ** 2 / (8 * bend) if bend < 0 else at)
        if np.isfinite(clearance) and np.min(np.abs(peaks)) <= TOUCH * clearance:
            numbers.append(contact + 1)
    return numbers
