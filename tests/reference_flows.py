"""Another flow to compare the compiled one with: its sensitivities by central differences."""

from contextlib import AbstractContextManager

import numpy as np

from vipetsc.modes.flow import Advance, Flow
from vipetsc.parallel import StopRequest


class FiniteDifferences(Flow):
    """Another flow with its sensitivities replaced by central differences.

    ``step`` is relative to the orbit's size; velocities count as displacements over a radian of the period.
    """

    def __init__(self, flow: Flow, step: float = 1e-6) -> None:
        super().__init__(flow.system)
        self.flow = flow
        self.step = step

    def limited(self, longest: int, stop: StopRequest | None) -> AbstractContextManager[None]:
        """Limit the arcs of the other flow, several of which make one of these."""
        return self.flow.limited(longest, stop)

    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        n = self.system.dofs
        rate = 2 * np.pi / period
        start = y[:, 0]
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / rate)
        columns = []
        for move in np.diag(self.step * size * np.repeat([1.0, rate], n)):
            beyond = self.flow.arc(start + move, duration, period).end
            before = self.flow.arc(start - move, duration, period).end
            columns.append((beyond - before) / (2 * move.max()))
        arc = self.flow.arc(start, duration, period)
        state = np.column_stack([arc.end, *columns])
        return Advance(state=state, events=arc.events, closed=arc.closed, steps=arc.steps)
