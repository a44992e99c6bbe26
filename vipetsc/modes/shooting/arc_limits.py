"""What ends an arc of Newton's method before its time: too many steps, or a request to stop.

From a good guess Newton's method goes to orbits near it, whose arcs take about as many steps of the flow as the arc of
the guess. Where the derivative is almost singular, as near a second branch, a step of the method may lead to any period
or amplitude. The flow takes a step for each radian of the fastest motion at least, and more of them for a spring that
hardens, so that an arc from there may take longer than any computation. Such an arc is no way to an orbit near the
guess: it ends the attempt.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from mpi4py import MPI

from vipetsc.modes.problem import FlowError
from vipetsc.parallel import StoppedError, StopRequest

# Steps of an arc of Newton's method at most, over those of the arc at its guess. In 428 attempts along the out-of-phase
# branches of the paper's model up to 10 kJ, with either law, the largest ratio is 2.8. Of 60 small systems on nonlinear
# springs, of which frequencies are multiples of others, two have attempts with ratios of 240 and 4,800 (and no orbit).
MOST_LONGER = 100
# More steps than any arc has.
UNLIMITED = 2**62


class ArcLimits:
    """Limits of the arcs of one flow, which calls ``check`` as it makes its steps.

    They act within a block of ``attempt`` alone. ``every`` is the number of steps, those of several arcs counted
    together, between two looks at requests to stop. Of a flow on several ranks, ``comm``, all make the same steps.
    """

    def __init__(self, every: int, comm: MPI.Comm = MPI.COMM_SELF) -> None:
        self._every = every
        self._comm = comm
        self._stop = StopRequest()
        self._is_attempt = False
        self._longest = UNLIMITED
        # Steps of the present arc, and those of all arcs since the last look.
        self._steps = 0
        self._since = 0

    @contextmanager
    def stopped_by(self, stop: StopRequest) -> Iterator[None]:
        """Let attempts within the block raise StoppedError where a ``stop`` is requested."""
        earlier = self._stop
        self._stop = stop
        try:
            yield
        finally:
            self._stop = earlier

    @contextmanager
    def attempt(self, longest: int = UNLIMITED) -> Iterator[None]:
        """A block in which Newton's method takes arcs of at most ``longest`` steps."""
        self._is_attempt = True
        self._longest = longest
        try:
            yield
        finally:
            self._is_attempt = False
            self._longest = UNLIMITED

    def refuse(self, steps: float) -> None:
        """Raise FlowError if an arc may not have so many ``steps``."""
        if steps > self._longest:
            raise FlowError(
                f"an arc of more than {self._longest} steps, {MOST_LONGER} times those of the arc at the guess"
            )

    def check(self, steps: int) -> int:
        """Note that the present arc has made so many ``steps``, 0 where it begins; returns at how many to call again.

        Within an attempt it raises FlowError if these are too many, and StoppedError if a stop is requested.
        """
        self.refuse(steps)
        if steps > 0:
            self.count(steps - self._steps)
        self._steps = steps
        return steps + min(self._every - self._since, self._longest + 1 - steps)

    def count(self, steps: int) -> None:
        """Count so many ``steps`` more; within an attempt it raises StoppedError, at a look, if a stop is requested."""
        self._since += steps
        if self._since < self._every:
            return
        self._since = 0
        if self._is_attempt and self._stop.agreed(self._comm):
            raise StoppedError("stopped on request; continue with --resume")
