"""Arcs of orbits: state, sensitivities and contact changes after a given time, by the flow of one's choice."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from vipetsc.modes import kernel
from vipetsc.modes.system import System


class FlowError(RuntimeError):
    """The flow could not cover the requested time."""


@dataclass(frozen=True, eq=False)
class Arc:
    """A piece of an orbit of ``duration`` seconds.

    ``start`` and ``end`` (2n,) hold displacements in m, then velocities in m/s; ``sensitivity`` (2n, 2n) is
    d end/d start; ``acceleration`` (2, n) in m/s^2 at both ends; ``events`` (changes, 4) lists time in s,
    contact, side (1 or -1) and kind (1 onset, -1 separation); ``closed`` the seconds with a contact closed.
    """

    duration: float
    start: np.ndarray
    end: np.ndarray
    sensitivity: np.ndarray
    acceleration: np.ndarray
    events: np.ndarray
    episodes: int
    closed: float


class Flow:
    """What every flow offers; a subclass gives its ``name``, ``_advance`` and allowed errors.

    ``rtol`` is the error per step relative to the orbit's size, ``rtol_sensitivity`` that of the sensitivities.
    """

    name: ClassVar[str]
    rtol: ClassVar[float] = 1e-13
    rtol_sensitivity: ClassVar[float] = 1e-11

    def __init__(self, system: System) -> None:
        self.system = system
        contacts = [(p.clearance, p.law.stiffness, p.law.exponent) for p in system.contacts]
        self.compiled = kernel.CompiledSystem(
            1 / np.asarray(system.masses, float),
            np.ascontiguousarray(system.stiffness, float),
            system.contact_rows,
            np.array(contacts, kernel.CONTACT),
            system.spring_rows,
            np.array([(s.quadratic, s.cubic) for s in system.springs], kernel.SPRING),
        )
        self.omega = float(system.linear_modes()[0][-1])

    def omega_ref(self, period: float) -> float:
        """Frequency in rad/s by which velocities count as displacements: the fastest linear mode's, or the orbit's."""
        return max(self.omega, 2 * np.pi / period)

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """The orbit from ``start`` (2n,) over ``duration`` seconds; ``period`` helps to choose steps.

        Raises FlowError if the time cannot be covered.
        """
        y = np.hstack([np.asarray(start, float)[:, None], np.eye(len(start))])
        y, events, closed = self._advance(y, duration, period)
        n, system = self.system.dofs, self.system
        end, sensitivity = y[:, 0].copy(), y[:, 1:].copy()
        acceleration = np.array([-system.forces(z[:n]) / system.masses for z in (start, end)])
        episodes = int(np.sum(system.gaps(start[:n]) > 0) + np.sum(events[:, 3] == 1))
        return Arc(duration, start, end, sensitivity, acceleration, events, episodes, closed)

    def _advance(self, y: np.ndarray, duration: float, period: float) -> tuple[np.ndarray, np.ndarray, float]:
        """State and variations (2n, 1 + 2n) after ``duration``, the arc's ``events`` and ``closed``; ``y`` is lost."""
        raise NotImplementedError


class FiniteDifferences(Flow):
    """Another flow with its sensitivities replaced by central differences, the paper's choice in region III.

    ``step`` is relative to the orbit's size; velocities count as displacements over a radian of the period.
    """

    name = "finite-differences"

    def __init__(self, flow: Flow, step: float = 1e-6) -> None:
        super().__init__(flow.system)
        self.flow, self.step = flow, step

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """See ``Flow.arc``."""
        n, rate = self.system.dofs, 2 * np.pi / period
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / rate)
        columns = []
        for move in np.diag(self.step * size * np.repeat([1.0, rate], n)):
            later, earlier = (self.flow.arc(start + s * move, duration, period).end for s in (1, -1))
            columns.append((later - earlier) / (2 * move.max()))
        return replace(self.flow.arc(start, duration, period), sensitivity=np.column_stack(columns))
