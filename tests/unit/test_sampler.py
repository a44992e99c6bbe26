"""Samplers of designs on functions in place of runs: CMA-ES, NSGA-II, fronts and their knees."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.studies.sampler import CmaEs, Nsga2, front, knee, smooth


def bowl(points):
    """Return losses that are least at (0.3, 0.4, ...), each direction ten times as steep as the one before."""
    number = np.arange(points.shape[1])
    return ((points - (0.3 + 0.1 * number)) ** 2 * 10.0**number).sum(axis=1, keepdims=True)


def no_excess(points):
    """Return the excess of points without constraints."""
    return np.zeros(len(points))


def search_with(sampler, function, generations, excess=no_excess):
    """Let a sampler minimise a function for some generations; return all points and their losses."""
    asked = []
    losses = []
    for _ in range(generations):
        asked.append(sampler.ask())
        losses.append(function(asked[-1]))
        sampler.tell(losses[-1], excess(asked[-1]))
    return np.concatenate(asked), np.concatenate(losses)


def two_bowls(points):
    """Return two losses that are least at different points."""
    return np.column_stack([bowl(points), bowl(1 - points)])


def cma():
    """Return CMA-ES in four dimensions from the middle of the cube, with its default generations of 8 points."""
    start = np.full(4, 0.5)
    return CmaEs(start, steps=np.zeros(4), directions=np.eye(4), step=0.2, seed=3, population=None)


def nsga():
    """Return NSGA-II in four dimensions from the middle of the cube."""
    return Nsga2(np.full(4, 0.5), step=0.2, seed=3, population=8)


def generation_sizes(sampler, function, generations):
    """Return how many points each generation of a search has."""
    sizes = []
    for _ in range(generations):
        points, _ = search_with(sampler, function, 1)
        sizes.append(len(points))
    return sizes


def test_cma_es_finds_the_least_and_stays_in_the_cube():
    """Sixty generations of eight points come near the minimum without leaving the cube."""
    points, losses = search_with(cma(), bowl, 60)

    assert len(points) == 60 * 8
    assert losses.min() < 1e-4 < losses[0]
    assert points.min() >= 0
    assert points.max() <= 1


@pytest.mark.parametrize(("make", "function"), [(cma, bowl), (nsga, two_bowls)])
def test_a_search_depends_on_its_seed_alone(make, function):
    """NumPy's global random numbers, which libraries may use, neither change a search nor are changed by it."""
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first, _ = search_with(make(), function, 12)
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002

    np.random.seed(2)  # noqa: NPY002
    second, _ = search_with(make(), function, 12)
    assert first.tobytes() == second.tobytes()


def left_of_the_middle(points):
    """Return how far points lie left of the middle of the cube, where a constraint is missed."""
    return np.maximum(0.0, 0.5 - points[:, 0])


# Failed designs have an infinite excess and no losses.
@pytest.mark.parametrize("failing", [0, 3])
def test_designs_that_miss_a_constraint_die_out(failing):
    """NSGA-II keeps feasible designs alone once it has found enough, however large their losses are."""
    sampler = Nsga2(np.array([0.45, 0.5]), step=0.02, seed=1, population=12)

    def losses(points):
        values = np.column_stack([10 + points[:, 0], 20 - points[:, 1]])
        values[:failing] = np.nan
        return values

    def excess(points):
        return np.where(np.isnan(losses(points)[:, 0]), np.inf, left_of_the_middle(points))

    points, _ = search_with(sampler, losses, 30, excess)
    assert (left_of_the_middle(points) == 0).sum() > 12
    survivors = sampler._search.pop.get("X").astype(float)
    assert len(survivors) == 12
    assert (left_of_the_middle(survivors) == 0).all()


def test_a_search_begins_again_at_the_best_feasible_point():
    """CMA-ES begins again at the feasible point of the least loss, also if losses are larger than any excess."""
    sampler = CmaEs(np.array([0.2, 0.2]), np.zeros(2), np.eye(2), step=0.05, seed=1, population=8)
    points, losses = search_with(sampler, lambda x: 5 + x[:, :1] ** 2, 150, left_of_the_middle)

    feasible = left_of_the_middle(points) == 0
    best = points[feasible][losses[feasible, 0].argmin()]
    assert sampler._best == pytest.approx(best)
    # A loss is least at the edge of what is feasible.
    assert best[0] == pytest.approx(0.5, abs=0.01)
    # On the way there the search prefers feasible points to others, whose losses are smaller.
    assert feasible[-200:].mean() > 0.25
    assert any((centre == sampler._centre).all() for centre in points[feasible])


def test_a_search_that_has_contracted_begins_again_with_more():
    """A search whose steps have become too short starts again with twice as many points a generation."""
    sizes = generation_sizes(cma(), bowl, 150)

    assert sizes[0] == 8
    assert 16 in sizes


def test_the_step_of_a_whole_number_does_not_vanish():
    """The step of a whole number stays large enough for its neighbours when the steps of other variables contract."""
    steps = np.array([0.0, 0.02])
    sampler = CmaEs(np.full(2, 0.52), steps, directions=np.eye(2), step=0.2, seed=5, population=None)

    points, _ = search_with(sampler, lambda p: ((p - 0.5) ** 2).sum(axis=1, keepdims=True), 30)

    # The last generations; the second variable is a whole number of 50 cells.
    assert np.std(points[-12:, 0]) < 0.001
    assert np.std(points[-12:, 1]) > 0.002


def test_a_first_generation_changes_neighbours_together():
    """The shapes of a first generation are independent with equal steps; neighbouring variables differ little."""
    shapes = smooth(10)
    step = 0.02
    sampler = CmaEs(np.full(10, 0.5), np.zeros(10), shapes, step, seed=4, population=4000)

    points = sampler.ask() - 0.5

    # The standard deviation of 4000 points has the relative error 1/8000^(1/2) = 1.1 %.
    assert np.std(points.mean(axis=1)) == pytest.approx(step, rel=0.05)
    modes = points @ shapes / (shapes**2).sum(axis=0)
    assert np.allclose(np.std(modes, axis=0), step, rtol=0.08)
    assert np.abs(np.corrcoef(modes.T) - np.eye(10)).max() < 0.1
    assert np.std(points[:, 0] - points[:, 1]) < step < np.std(points[:, 0] - points[:, -1])


def test_nsga_ii_finds_the_front_of_two_bowls():
    """The front of the squared distances from two points is the straight line between these points."""
    ends = np.array([[0.2, 0.2, 0.2], [0.8, 0.8, 0.2]])

    def squared_distances(points):
        return ((points[:, None] - ends) ** 2).sum(axis=2)

    sampler = Nsga2(np.full(3, 0.5), step=0.2, seed=3, population=20)
    points, losses = search_with(sampler, squared_distances, generations=50)

    best = points[front(losses)]
    # Most of a generation of 20 points lie on the front, along most of the line and near it.
    assert len(best) > 15
    assert np.ptp(best[:, 0]) > 0.4
    assert np.abs(best[:, 0] - best[:, 1]).max() < 0.1
    assert np.abs(best[:, 2] - 0.2).max() < 0.1


def test_a_front_has_what_nothing_is_better_than_and_its_knee():
    """The front is in the order of its first loss, without doubles or NaN; its knee lies farthest below its chord."""
    losses = np.array([[3.0, 0.0], [1.0, 1.0], [2.0, 2.0], [0.0, 4.0], [1.0, 1.0], [np.nan, -9.0], [0.0, 5.0]])
    assert front(losses).tolist() == [3, 1, 0]
    assert knee(losses[front(losses)]) == 1

    # The front of one loss is the first point of the least loss; it is empty if all points failed.
    assert front(np.array([[2.0], [np.nan], [1.0], [1.0]])).tolist() == [2]
    assert front(np.full((2, 2), np.nan)).size == 0
