"""The designs that a search has tried, and the exchange with the sampler that asks for more."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from vipetsc.case import Case, CaseError, case_id
from vipetsc.case.optimise import OptimiseCase
from vipetsc.studies.objective import ObjectiveRuns
from vipetsc.studies.sampler import Sampler, front, knee

ROUNDED = 1e-12  # relative difference of values that differ by rounding alone


@dataclass
class Design:
    """A design that was tried: its ``values`` (variable) and its results.

    ``case`` is None and ``runs`` are empty if the values make no valid case. ``losses`` (objective) are small for a
    good design, NaN for one that failed, whose ``reason`` says why. ``constraints`` (constraint) are the values of what
    is bounded, ``excess`` sums by how much they are out of bounds.
    """

    values: np.ndarray
    generation: int
    case: Case | None = None
    runs: Sequence[Case] = ()
    reason: str = ""
    losses: list[float] = field(default_factory=list)
    constraints: list[float] = field(default_factory=list)
    excess: float = 0.0


class OptimumSearch:
    """The ``designs`` tried so far, on one rank: number 0 is the case to begin with, 1 the ``start`` if that differs.

    ``asked`` are the designs that are not judged yet: at first these, then those that the ``sampler`` has asked for.
    ``objective`` has the runs of all designs and judges by them; ``start`` are values (variable,).
    """

    def __init__(self, plan: OptimiseCase, objective: ObjectiveRuns, sampler: Sampler, start: np.ndarray) -> None:
        self.plan = plan
        self.objective = objective
        self.sampler = sampler
        self.start = start
        self.designs = [Design(plan.begin(), 0, plan.base, [*objective.runs(plan.base).values()])]
        # The case itself is a design even where the search begins elsewhere: results are compared with it.
        first = self._design(start, 0)
        if first.case is None or case_id(first.case) != case_id(plan.base):
            self.designs.append(first)
        self.asked = self.designs

    def _design(self, values: np.ndarray, generation: int) -> Design:
        """Return the design of ``values`` (variable), with its runs, or with the reason why it is not possible."""
        try:
            case = self.plan.design(values)
            return Design(values, generation, case, [*self.objective.runs(case).values()])
        except CaseError as error:
            return Design(values, generation, reason="; ".join(map(str, error.problems)))

    def runs(self) -> list[Case]:
        """Return the runs of the designs that are not judged yet."""
        return [run for design in self.asked for run in design.runs]

    def tell_and_ask(self) -> bool:
        """Judge the ``asked`` designs, whose runs are recorded, report to the sampler, and ask it for more.

        Returns False if the budget is spent, and no more designs are asked for.
        """
        for design in self.asked:
            options = self.plan.options
            design.losses = [np.nan] * len(options.objective)
            design.constraints = [np.nan] * len(options.constraint or [])
            if design.case:
                judgement = self.objective.judge(design.case)
                design.losses = judgement.losses
                design.constraints = judgement.constraints
                design.excess = judgement.excess
                design.reason = judgement.reason

        left = self.plan.options.budget - len(self.designs)
        if left <= 0:
            return False

        generation = self.asked[0].generation
        if generation:
            self._tell()
        else:
            # The case and the start, which the sampler did not ask for. The start is the last of them.
            first = self.asked[-1]
            self.sampler.know_start(np.array(first.losses), first.excess)
        points = self.sampler.ask()[:left]
        self.asked = [self._design(self._values(point), generation + 1) for point in points]
        self.designs += self.asked
        return True

    def _values(self, point: np.ndarray) -> np.ndarray:
        """Return the values (variable,) at a ``point`` (variable,) of the unit cube that the sampler asks for."""
        values = self.plan.space.from_unit(point)
        # NSGA-II asks for the start, too. On the way into the cube and back its values are rounded, and would make
        # another design with runs of its own.
        if np.allclose(values, self.start, rtol=ROUNDED, atol=0.0):
            return self.start
        return values

    def _tell(self) -> None:
        """Give the sampler the losses and the excess of the designs that it asked for."""
        losses = np.array([design.losses for design in self.asked])
        excess = np.array([design.excess for design in self.asked])
        # A design that failed misses its constraints by more than any other.
        excess[~np.isfinite(losses).all(axis=1)] = np.inf
        self.sampler.tell(losses, excess)

    def losses(self) -> np.ndarray:
        """Return losses of all designs (design, objective)."""
        return np.array([design.losses for design in self.designs])

    def feasible_losses(self) -> np.ndarray:
        """Return losses of all designs (design, objective), NaN for those that miss a constraint."""
        is_feasible = np.array([design.excess == 0 for design in self.designs])
        return np.where(is_feasible[:, None], self.losses(), np.nan)

    def compared(self) -> dict[str, int]:
        """Return numbers of the designs to be compared by name: the case, and the best or the front's ends and knee."""
        losses = self.feasible_losses()
        best = front(losses)
        if not best.size:
            return {"case": 0}
        if losses.shape[1] == 1:
            return {"case": 0, "best": int(best[0])}
        middle = int(best[knee(losses[best])])
        return {"case": 0, "best-1": int(best[0]), "best": middle, "best-2": int(best[-1])}
