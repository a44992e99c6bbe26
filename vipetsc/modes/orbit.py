"""Arcs of orbits: state, sensitivities and contact changes after a given time, by the flow of one's choice."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from vipetsc.modes import kernel
from vipetsc.modes.system import System, contact_directions, direction

MOST_CHANGES = 2000
"""Contact changes of one arc beyond which a flow gives up."""


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
    steps: int

    def blocks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The (n, n) blocks du/du0, du/dv0, dv/du0, dv/dv0 of the sensitivity."""
        n, s = len(self.start) // 2, self.sensitivity
        return s[:n, :n], s[:n, n:], s[n:, :n], s[n:, n:]


class Flow:
    """What every flow offers; a subclass gives its ``name``, ``arc`` and allowed errors.

    ``rtol`` is the error per step relative to the orbit's size, ``rtol_sensitivity`` that of the sensitivities.
    """

    name: ClassVar[str]
    rtol: ClassVar[float] = 1e-13
    rtol_sensitivity: ClassVar[float] = 1e-11

    def __init__(self, system: System) -> None:
        self.system = system
        self.compiled = compile_system(system)
        self.omega = float(system.linear_modes()[0][-1])

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """The orbit from ``start`` (2n,) over ``duration`` seconds; ``period`` helps to choose steps.

        Raises FlowError if the time cannot be covered.
        """
        raise NotImplementedError

    def omega_ref(self, period: float) -> float:
        """Frequency in rad/s by which velocities count as displacements: the fastest linear mode's, or the orbit's."""
        return max(self.omega, 2 * np.pi / period)

    def with_variations(self, start: np.ndarray) -> np.ndarray:
        """The state (2n,) and the identity's columns beside it (2n, 1 + 2n)."""
        return np.hstack([np.asarray(start, float)[:, None], np.eye(len(start))])

    def finish(
        self, start: np.ndarray, y: np.ndarray, duration: float, events: np.ndarray, closed: float, steps: int
    ) -> Arc:
        """An arc from its start, state and variations ``y`` (2n, 1 + 2n) at its end, and what happened on the way."""
        n, system = self.system.dofs, self.system
        end, sensitivity = y[:, 0].copy(), y[:, 1:].copy()
        acceleration = np.array([-system.forces(z[:n]) / system.masses for z in (start, end)])
        episodes = int(np.sum(system.gaps(start[:n]) > 0) + np.sum(events[:, 3] == 1))
        return Arc(duration, start, end, sensitivity, acceleration, events, episodes, closed, steps)


class Dop853Flow(Flow):
    """Dormand and Prince's 8(5,3) pair, landing on every contact change; see ``kernel``."""

    name = "compiled"

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """See ``Flow.arc``."""
        y, events = self.with_variations(start), np.empty((MOST_CHANGES, 4))
        tolerances = kernel.Tolerances(self.rtol, self.rtol_sensitivity, self.omega_ref(period))
        outcome, count, closed, steps = kernel.flow(self.compiled, tolerances, y, duration, events)
        if outcome != kernel.DONE:
            why = {kernel.STUCK: "the step became too small", kernel.FULL: f"more than {MOST_CHANGES} contact changes"}
            raise FlowError(f"the flow stopped after {count} contact changes in {duration:.6g} s: {why[outcome]}")
        return self.finish(start, y, duration, events[:count].copy(), closed, steps)


def compile_system(system: System) -> kernel.CompiledSystem:
    """The record of a system."""
    contacts = [(p.clearance, p.law.stiffness, p.law.exponent) for p in system.contacts]
    spring_rows = [direction(s.start, s.end, system.dofs) for s in system.springs]
    return kernel.CompiledSystem(
        1 / np.asarray(system.masses, float),
        np.ascontiguousarray(system.stiffness, float),
        contact_directions(system),
        np.array(contacts, kernel.CONTACT),
        np.array(spring_rows, float).reshape(len(spring_rows), system.dofs),
        np.array([(s.quadratic, s.cubic) for s in system.springs], kernel.SPRING),
    )


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
        n = self.system.dofs
        centre = self.flow.arc(start, duration, period)
        rate = 2 * np.pi / period
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / rate)
        columns = []
        for move in np.diag(self.step * size * np.repeat([1.0, rate], n)):
            later, earlier = (self.flow.arc(start + s * move, duration, period).end for s in (1, -1))
            columns.append((later - earlier) / (2 * move.max()))
        return replace(centre, sensitivity=np.column_stack(columns))
