"""One continuation of a branch from a motion to its end: its points, special points, warnings and writings.

``Continuation`` makes the steps. Around it, each regular point is *assessed* (``Method.assess`` adds the quantities of
its file that continuation does not need), compared with all earlier ones by the method's *monitor*, shown to a
listener, and written from time to time.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from vipetsc.endings import Ended, Ending
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.method import Method, Monitor
from vipetsc.modes.continuation.arclength import Continuation, StepRule, locate
from vipetsc.modes.problem import PeriodicProblem
from vipetsc.parallel import StoppedError, StopRequest

# Seconds between two writings of a growing branch: what a kill may lose.
SAVE_EVERY = 10.0

Listener = Callable[[Branch[Any], Any], None]
RuleOf = Callable[[PeriodicProblem[Any], Any, int], StepRule[Any]]


@dataclass
class Growth:
    """Continues branches of a ``method``, one after the other.

    ``write(branch)`` writes a branch as far as it has come. ``listener(branch, point)``, if there is one, is called
    after each regular point. A ``stop`` ends the branch at its next point, or within a step that takes long.
    """

    method: Method[Any]
    write: Callable[[Branch[Any]], None]
    listener: Listener | None
    stop: StopRequest

    def run(
        self, branch: Branch[Any], problem: PeriodicProblem[Any], start: Any, rule_of: RuleOf, direction: int = 1
    ) -> None:
        """Continue ``branch`` from the motion ``start`` until it ends, and set how it ``ended``.

        Special points are located between the regular ones.

        ``rule_of(problem, start, done)`` gives the steps and the end of a branch that has ``done`` regular points after
        its start. A ``start`` with a tangent is continued along it. From one without, a branch goes towards growing
        energy (of an NFRC, its parameter) if the ``direction`` is 1, towards falling energy if it is -1.

        Raises ContinuationError, FlowError or another of the method's ``failures`` if it cannot go on, StoppedError
        on request; the branch holds the points so far.
        """
        regular = branch.regular()
        # Points of an earlier run count against the number that a branch may have; its start does not.
        done = max(len(regular) - 1, 0)
        # A closed curve ends where it began, also if it is resumed elsewhere.
        first = start
        if regular:
            first = regular[0]
        rule = rule_of(problem, first, done)
        # The ending of a branch that has used up its points tells their number as its case counts them.
        counted = done + int(self.method.counts_start)
        # ``next_step`` is 0 of a branch without points: its first step is then the rule's.
        continuation = Continuation(
            problem, start, rule, direction, step=branch.next_step or None, points_before=counted
        )
        monitor = self.method.monitor(problem)
        # The monitor compares each point with all earlier ones, to see whether the branch retraces itself or returns to
        # the linear mode. A resumed branch must be judged as one that was not interrupted: that one began without
        # points, so that its monitor has not seen the start.
        for point in regular[1:]:
            monitor(point)
        if not branch.points:
            branch.points = [self.method.assess(problem, continuation.point)]

        try:
            with problem.stopped_by(self.stop):
                seen = self._steps(branch, problem, continuation, rule.chart, monitor)
        except StoppedError:
            # A step in which the branch was stopped is left out, and repeated by a resumed branch.
            self.write(branch)
            last = branch.regular()[-1]
            stopped = Ending.STOPPED.with_numbers(where=f"after point {last.index}; continue with --resume")
            raise StoppedError(stopped.sentence) from None
        branch.ended = seen or continuation.ended

    def _steps(
        self,
        branch: Branch[Any],
        problem: PeriodicProblem[Any],
        continuation: Continuation[Any],
        chart: str,
        monitor: Monitor[Any],
    ) -> Ended | None:
        """Add all points to the ``branch``; returns its ending if the ``monitor`` has ended it, else None.

        ``chart`` is the name of the unknowns in which steps are taken (``Continuation``).
        """
        last = continuation.point
        chosen = self.method.chosen(problem)
        # A special point between the newest two points may need the direction of the one before them.
        one_before_last = None
        regular = branch.regular()
        if len(regular) > 1:
            one_before_last = regular[-2]

        saved = time.monotonic()
        for point in continuation:
            sys.audit("vipetsc.step")
            special: list[Any] = []
            missed: list[str] = []
            if self.method.locates:
                special = locate(
                    problem,
                    left=last,
                    # The end of the step itself. It is ``point``, unless the rule has moved that back to the end of a
                    # range: special points of the whole step are wanted.
                    right=continuation.passed,
                    chart=chart,
                    grazing=self.method.locates_grazing,
                    before=one_before_last,
                    missed=missed,
                    chosen=chosen,
                )

            # As in regular points, ``next_step`` is that of the step after the one that found them.
            special = [replace(p, next_step=point.next_step) for p in special]
            new_points = [self.method.assess(problem, p) for p in [*special, point]]
            # A step is taken as a whole, or not at all where an assessment fails: a resumed branch repeats the step.
            branch.findings += missed
            branch.points += new_points
            assessed = new_points[-1]
            branch.next_step = continuation.step
            if self.listener is not None:
                self.listener(branch, assessed)
            ended = monitor(assessed)
            if ended is not None:
                branch.findings.append(ended.sentence)
                return ended

            if self.stop.requested and not continuation.finished:
                raise StoppedError
            is_due = time.monotonic() - saved > SAVE_EVERY
            # A branch that has ended is written later, as complete: after a kill it would go on beyond its end.
            if is_due and not continuation.finished:
                self.write(branch)
                saved = time.monotonic()
            one_before_last = last
            last = point
        return None
