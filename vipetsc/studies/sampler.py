"""Samplers of designs: CMA-ES for one objective, NSGA-II for two; the same designs from the same seed.

Either is asked for points (design, variable) of the unit cube and then given the losses (design, objective), which are
to become small, of all of them in that order. Neither draws from numpy's global state.
"""

from typing import Any

import numpy as np

RESOLVED = 1e-4  # of the range between the bounds: impacts turn a finer change into noise
LARGEST = 8  # times the first population: three restarts, each of which looks at a larger part of the range
WHOLE = 0.3  # least standard deviation of a whole number: a tenth of the designs then have a neighbouring one


class CmaEs:
    """Covariance matrix adaptation (Hansen 2016, arXiv:1604.00772), by ``cma``.

    A search that has contracted begins again at the best point, with twice the population, up to ``LARGEST`` times the
    first. ``steps`` (variable) are those of whole numbers in the unit cube, 0 for others. It begins with the deviation
    ``step`` along each of the ``directions`` (variable, direction); points beyond the cube are mirrored into it.
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
        self._best: tuple[float, np.ndarray] = np.inf, start
        self._begin({"popsize": population} if population else {})
        # The package chooses a population by the number of variables where none is given.
        self._first = int(self._search.popsize)

    def _begin(self, options: dict[str, Any]) -> None:
        from cma.evolution_strategy import CMAEvolutionStrategy

        options |= {
            "minstd": (WHOLE * self._steps).tolist(),
            "tolx": RESOLVED,
            "randn": lambda *shape: self._random.standard_normal(shape),
            "seed": np.nan,  # cma would seed numpy's global state
            "verbose": -10,  # nor does it read options from a file cma_signals.in
        }
        self._centre = self._best[1]
        self._search = CMAEvolutionStrategy([0.0] * len(self._centre), self._step, options)

    def ask(self) -> np.ndarray:
        """The next generation (design, dimension), each coordinate in [0, 1]."""
        self._asked = self._search.ask()
        unbounded = self._centre + np.array(self._asked) @ self._directions.T
        self._points = 1 - np.abs(1 - unbounded % 2)  # mirrored at 0 and 1
        return self._points

    def tell(self, losses: np.ndarray) -> None:
        """Report the losses (design, 1) of the generation that was asked for."""
        least = int(np.argmin(losses[:, 0]))
        if losses[least, 0] < self._best[0]:
            self._best = float(losses[least, 0]), self._points[least]
        self._search.tell(self._asked, losses[:, 0].tolist())
        if self._search.stop():
            self._begin({"popsize": min(2 * len(self._asked), LARGEST * self._first)})


class Nsga2:
    """Nondominated sorting genetic algorithm (Deb et al. 2002, IEEE Trans. Evol. Comput. 6, 182), by ``pymoo``.

    The first generation is normal about the ``start``, with the standard deviation ``step``.
    """

    def __init__(self, start: np.ndarray, step: float, seed: int, population: int, objectives: int = 2) -> None:
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination

        first = start + step * np.random.default_rng(seed).standard_normal((population, len(start)))
        # The start itself, which a search that is stopped early must not miss.
        first[0] = start
        self._problem = Problem(n_var=len(start), n_obj=objectives, xl=0.0, xu=1.0)
        self._search = NSGA2(pop_size=population, sampling=np.clip(first, 0.0, 1.0))
        self._search.setup(self._problem, termination=NoTermination(), seed=seed)

    def ask(self) -> np.ndarray:
        """The next generation (design, dimension), each coordinate in [0, 1]."""
        self._asked = self._search.ask()
        return np.array(self._asked.get("X"), float)

    def tell(self, losses: np.ndarray) -> None:
        """Report the losses (design, objective) of the generation that was asked for."""
        from pymoo.core.evaluator import Evaluator
        from pymoo.problems.static import StaticProblem

        Evaluator().eval(StaticProblem(self._problem, F=losses), self._asked)
        self._search.tell(infills=self._asked)


Sampler = CmaEs | Nsga2


def smooth(count: int) -> np.ndarray:
    """Directions (variable, direction) in which like variables in a row change together first, one by one last.

    Cosines over the row: the mean by 1, the slope by 1/2, the bend by 1/3 (root mean square over the row), and so on.
    """
    order = np.arange(count)
    normalisation = np.where(order, np.sqrt(2), 1)
    cosines = np.cos(np.pi * np.outer(order + 0.5, order) / count) * normalisation
    return np.asarray(cosines / (1 + order))


def front(losses: np.ndarray) -> np.ndarray:
    """The designs whose ``losses`` (design, objective) no other betters: all finite, sorted by the first objective.

    Of equal ones the first is taken; for one objective it is the best.
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
    """The design of a front whose ``losses`` (design, objective) are farthest below the line between its ends."""
    span = np.ptp(losses, axis=0)
    scaled = (losses - losses.min(axis=0)) / np.where(span > 0, span, 1.0)
    return int(np.argmin(scaled.sum(axis=1)))
