"""Samplers of designs: CMA-ES for one objective, NSGA-II for two; the same designs from the same seed.

A sampler is asked for a generation of points (design, variable) in the unit cube, and is then told their losses
(design, objective), which it makes small, and their excess (design,), by how much constraints are missed in sum: inf
for a design that failed. A design that misses none is better than all that miss any, and of two that do the one with
the smaller excess is better (Deb 2000, Comput. Methods Appl. Mech. Eng. 186, 311). Neither draws from numpy's global
state.
"""

from typing import Any

import numpy as np

RESOLVED = 1e-4  # of the range between the bounds: impacts turn a finer change into noise
# Largest population over the first one. It is reached after three restarts, each with twice the population, which looks
# at a larger part of the cube.
LARGEST = 8
# Least standard deviation of a whole number, in steps of it: a normal deviate exceeds half a step in one design of ten,
# which then has a neighbouring number.
WHOLE = 0.3


class CmaEs:
    """Covariance matrix adaptation (Hansen 2016, arXiv:1604.00772), by ``cma``.

    The search begins at the point ``start`` (variable,) of the unit cube, with the standard deviation ``step`` along
    each of the ``directions`` (variable, direction); points beyond the cube are mirrored into it. When it has
    contracted it begins again at the best point so far, with twice the population, up to ``LARGEST`` times the first.
    ``steps`` (variable,) are the distances of neighbouring whole numbers in the cube, 0 for real variables; the
    direction of a whole number must be its own axis. ``population`` is the size of the first generation, by default
    what ``cma`` takes for the number of variables.
    """

    def __init__(
        self,
        start: np.ndarray,
        steps: np.ndarray,
        directions: np.ndarray,
        step: float,
        seed: int,
        population: int | None,
    ) -> None:
        self._random = np.random.default_rng(seed)
        self._step = step
        self._steps = steps
        self._directions = directions
        # Compared in this order: what misses no constraint comes first.
        self._least = (np.inf, np.inf)
        self._best = start
        self._begin(population)
        self._first = int(self._search.popsize)

    def _begin(self, population: int | None) -> None:
        """Begin at the best point so far; without a ``population`` the package chooses one."""
        from cma.evolution_strategy import CMAEvolutionStrategy

        options: dict[str, Any] = {
            "minstd": (WHOLE * self._steps).tolist(),
            "tolx": RESOLVED,
            "randn": lambda *shape: self._random.standard_normal(shape),
            "seed": np.nan,  # with a number cma would seed numpy's global state
            "verbose": -10,  # from -9 on cma would read options from a file cma_signals.in
        }
        if population:
            options["popsize"] = population
        # The search runs in coordinates along the directions, with the best point as their origin.
        self._centre = self._best
        self._search = CMAEvolutionStrategy([0.0] * len(self._centre), self._step, options)

    def ask(self) -> np.ndarray:
        """Return the next generation (design, variable), each coordinate in [0, 1]."""
        self._asked = self._search.ask()
        unbounded = self._centre + np.array(self._asked) @ self._directions.T
        # Mirrored at 0 and 1, again and again: the triangle wave of period 2.
        self._points = 1 - np.abs(1 - unbounded % 2)
        return self._points

    def know_start(self, losses: np.ndarray, excess: float) -> None:
        """Take the losses (1,) and the ``excess`` of the start, which is not one of the points that are asked for."""
        if np.isfinite(losses).all():
            self._least = (excess, float(losses[0]))

    def tell(self, losses: np.ndarray, excess: np.ndarray) -> None:
        """Take the losses (design, 1) and the ``excess`` (design,) of the generation that was asked for.

        Begins again if the search has contracted.
        """
        order = np.lexsort((losses[:, 0], excess))
        first = int(order[0])
        least = (float(excess[first]), float(losses[first, 0]))
        if least < self._least:
            self._least = least
            self._best = self._points[first]

        # The search looks at the order of the values in a generation alone, and ends where they are all equal. Designs
        # that miss a constraint come behind the others, at any distance.
        missed = order[excess[order] > 0]
        values = losses[:, 0].copy()
        worst = np.max(losses[excess == 0, 0], initial=0.0)
        values[missed] = worst + (1 + abs(worst)) * np.arange(1, len(missed) + 1)
        self._search.tell(self._asked, values.tolist())
        if self._search.stop():
            self._begin(min(2 * len(self._asked), LARGEST * self._first))


class Nsga2:
    """Nondominated sorting genetic algorithm (Deb et al. 2002, IEEE Trans. Evol. Comput. 6, 182), by ``pymoo``.

    The first generation, of ``population`` points, is normal about the ``start`` (variable,), with the standard
    deviation ``step``, and clipped to the unit cube.
    """

    def __init__(self, start: np.ndarray, step: float, seed: int, population: int, objectives: int = 2) -> None:
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        first = start + step * np.random.default_rng(seed).standard_normal((population, len(start)))
        # The start itself, which a search that is stopped early must not miss.
        first[0] = start
        self._problem = Problem(n_var=len(start), n_obj=objectives, n_ieq_constr=1, xl=0.0, xu=1.0)
        self._search = NSGA2(pop_size=population, sampling=np.clip(first, 0.0, 1.0))
        self._search.setup(self._problem, termination=NoTermination(), seed=seed)

    def ask(self) -> np.ndarray:
        """Return the next generation (design, variable), each coordinate in [0, 1]."""
        self._asked = self._search.ask()
        return np.array(self._asked.get("X"), float)

    def know_start(self, losses: np.ndarray, excess: float) -> None:
        """Do nothing: the start is one of the points that are asked for."""

    def tell(self, losses: np.ndarray, excess: np.ndarray) -> None:
        """Take losses (design, objective) and ``excess`` (design,) of the generation that was asked for."""
        from pymoo.core.evaluator import Evaluator
        from pymoo.problems.static import StaticProblem

        # Losses of a design that failed are not compared, but must be numbers.
        finite = np.where(np.isfinite(losses), losses, 0.0)
        Evaluator().eval(StaticProblem(self._problem, F=finite, G=excess[:, None]), self._asked)
        self._search.tell(infills=self._asked)


Sampler = CmaEs | Nsga2


def smooth(count: int) -> np.ndarray:
    """Return directions (variable, direction) of ``count`` variables in a row, as clearances of neighbouring sites.

    They are cosines over the row, the k-th from 0 with k half waves and the root mean square 1/(1 + k): a step changes
    the mean most, the slope half as much, the bend a third as much, and differences of neighbours least.
    """
    order = np.arange(count)
    normalisation = np.where(order, np.sqrt(2), 1)
    cosines = np.cos(np.pi * np.outer(order + 0.5, order) / count) * normalisation
    return np.asarray(cosines / (1 + order))


def front(losses: np.ndarray) -> np.ndarray:
    """Return the numbers of the designs in the Pareto front of ``losses`` (design, objective), by the first objective.

    No other design is as good in every objective; of equal designs the first is taken. Designs with a loss that is not
    finite are left out. For one objective the front is the best design.
    """
    finite = np.flatnonzero(np.isfinite(losses).all(axis=1))
    # Sorted by the first objective, then by the second: a design can only be dominated by one before it.
    order = finite[np.lexsort(losses[finite].T[::-1])]
    best: list[int] = []
    for number in order:
        if not any((losses[other] <= losses[number]).all() for other in best):
            best.append(int(number))
    return np.array(best, int)


def knee(losses: np.ndarray) -> int:
    """Return the number of the design whose ``losses`` (design, objective) are farthest below the ends' line."""
    # Over its span the front has the ends (0, 1) and (1, 0), and a design is below their line by what its sum is less.
    span = np.ptp(losses, axis=0)
    scaled = (losses - losses.min(axis=0)) / np.where(span > 0, span, 1.0)
    return int(np.argmin(scaled.sum(axis=1)))
