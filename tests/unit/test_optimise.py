"""The section [optimise], designs as points of a cube, samplers on stand-ins, fronts."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import search_table
from vipetsc.case import CaseError, case_id
from vipetsc.case.disorder import Deviation
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.verb_cases import load_every
from vipetsc.parallel import StopRequest
from vipetsc.studies.objective import ObjectiveRuns
from vipetsc.studies.optimum_search import OptimumSearch
from vipetsc.studies.recorded_runs import RecordedRuns
from vipetsc.studies.sampler import CmaEs, Nsga2, front, knee, smooth

BOUNDS = {"budget": 12, "variables": {"clearance": [1e-5, 1e-2]}}
TABLE = search_table(40, [10, 20, 30], contacts={"clearance": {"first": 2e-4, "last": 1e-4}}, optimise=BOUNDS)


def test_designs_of_other_cells_keep_smooth_parts_and_dashpots():
    parts = {"quadratic": -2e6, "cubic": 3e9, "damping": 0.5}
    springs = [
        {"start": 1, "end": 1, "stiffness": 4e3, "next_cell": True} | parts,
        {"start": 1, "end": 2, "stiffness": 2e3},
    ]
    cell = {"masses": [0.01, 0.02], "springs": springs, "contact": [1, 2]}
    table = TABLE | {"lattice": {"cell": cell, "cells": 40}, "drive": {"frequency": 300.0, "cycles": 3}}
    table |= {"contacts": {"sites": [10, 20], "clearance": 1e-4, "stiffness": 1e6}}
    table |= {"optimise": {"budget": 12, "variables": {"springs": {"1": [1e3, 1e4]}},
                           "objective": [{"measure": "transmitted"}]}}  # fmt: skip
    case = OptimiseCase.from_table(table).design(np.array([5e3]))
    first, second = case.lattice.unit_cell().springs
    assert first.stiffness == 5e3 and {key: getattr(first, key) for key in parts} == parts
    assert second.stiffness == 2e3 and not (second.cubic or second.damping)


def plan(*changes: str) -> OptimiseCase:
    return OptimiseCase.from_table(TABLE, changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["contacts.sites=0", "contacts.clearance="], "no sites"),
        (["optimise.variables.clearance=[-1e-3, 1e-2]"], "clearance[1] = -0.001: must be greater than 0"),
        (["optimise.variables.clearance=[1e-2, 1e-3]"], "low below high"),
        (["optimise.objective=[{measure='band_share'}]"], "objective[1].band: missing; band_share needs a band"),
        (["optimise.objective=[{measure='band_share', band=5}]"], "the cell has 4 bands"),
        (["optimise.objective=[{measure='ibtet', band=2}]"], "only band_share has a band"),
        (["optimise.objective=[{measure='band_share', band=4, part=[100.0, 200.0]}]"], "meet band 4, 3214.9-3644.8"),
        (["optimise.objective=[{measure='ibtett'}]"], "did you mean 'ibtet'"),
        (["optimise.objective=[]"], "optimise.objective"),
        (["optimise.variables.clearence=[1e-3, 1e-2]"], "did you mean optimise.variables.clearance"),
        (["optimise.variables.clearance="], "names nothing that varies"),
        (["optimise.variables.profile=[1e-3, 1e-2]"], "not both"),
        (["optimise.variables.masses.5=[1e-3, 1e-2]"], "masses count from 1 to 4"),
        (["optimise.variables.springs.x=[1e3, 1e4]"], "springs count from 1 to 4"),
        (["optimise.variables.sites=[10, 11]"], "within cells 1 to 40 and hold all 3 sites"),
        (["optimise.variables.sites=[0, 30]"], "within cells 1 to 40"),
        (["optimise.variables.restitution=[0.5, 1.5]"], "restitution[2] = 1.5"),
        (["optimise.variables={restitution=[0.5, 0.9]}", "optimise.start=matched"], "let clearance or profile vary"),
        (["optimise.samples=3"], "no [disorder]"),
        (["disorder.clearance.relative=-0.1"], "disorder.clearance.relative = -0.1"),
        (["contacts.sites=[50]"], "outside the lattice"),
        (["lattice.ends=periodic", "optimise.objective=[{measure='transmitted'}]"], "the last site of a ring"),
        (["lattice.preset=diatomic", "drive={wavenumber='5pi/9', band=2}"], "the driven band is the highest of 2"),
        (["optimise=3"], "say what varies"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_search_is_named(changes, message):
    with pytest.raises(CaseError) as error:
        plan(*changes)
    assert message in str(error.value)
    assert len(error.value.problems) == 1


def test_all_problems_come_at_once(tmp_path):
    path = tmp_path / "bad.toml"
    wrong = {"masses": {"9": [1.0, 2.0]}, "sites": [30, 2]}
    path.write_text(tomli_w.dumps(TABLE | {"optimise": BOUNDS | {"variables": BOUNDS["variables"] | wrong}}))
    for read in (OptimiseCase.load, load_every):
        with pytest.raises(CaseError) as error:
            read(path)
        assert [p.key for p in error.value.problems] == ["optimise.variables.masses.9", "optimise.variables.sites"]


def test_the_case_as_text_gives_the_same_search():
    first = plan(
        "optimise.variables.sites=[2, 39]", "optimise.samples=3", "disorder.clearance.relative=0.01", "time.rtol=1e-8"
    )
    again = OptimiseCase.from_toml(first.to_toml())
    assert again == first and again.options.samples == 3


def test_the_start_is_the_case():
    searched = plan("optimise.variables.sites=[2, 39]", "optimise.variables.restitution=[0.0, 1.0]")
    values = searched.begin()
    assert case_id(searched.design(values)) == case_id(searched.base)
    assert np.allclose(searched.from_unit(searched.to_unit(values)), values, rtol=1e-12)


def test_a_profile_is_log_spaced_and_a_cell_takes_its_masses_and_springs():
    bounds = "{profile=[1e-5, 1e-2], masses={3=[1e-3, 1e-2]}, springs={4=[1e2, 1e4]}}"
    searched = plan(f"optimise.variables={bounds}")
    assert [v.name for v in searched.variables()] == ["first clearance", "last clearance", "mass 3", "spring 4"]
    case = searched.design(np.array([4e-4, 1e-4, 4e-3, 1500.0]))
    assert case.contacts.clearance == pytest.approx([4e-4, 2e-4, 1e-4])
    cell, given = case.lattice.unit_cell(), searched.base.lattice.unit_cell()
    assert cell.masses == (*given.masses[:2], 4e-3, given.masses[3]) and cell.springs[3].stiffness == 1500.0
    assert cell.springs[:3] == given.springs[:3] and (cell.host, cell.resonator) == (given.host, given.resonator)
    # The wave is that of the new cell, in the same band at its fastest.
    assert case.drive.frequency != searched.base.drive.frequency
    assert case.contacts.stiffness == searched.base.contacts.stiffness


@pytest.mark.slow
@settings(max_examples=60)
@given(st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=3), st.sampled_from([(1, 40), (7, 9), (38, 40), (5, 30)]))
def test_sites_are_distinct_in_order_and_within_their_bounds(point, bounds):
    searched = plan("optimise.variables.clearance=", f"optimise.variables.sites=[{bounds[0]}, {bounds[1]}]")
    cells = searched.from_unit(np.array(point))
    assert np.all(np.diff(cells) >= 1) and cells[0] >= bounds[0] and cells[-1] <= bounds[1]
    assert searched.design(cells).contacts.sites == cells.astype(int).tolist()


def bowl(points):
    """Least at .3, .4, ...; ill-scaled."""
    at = 0.3 + 0.1 * np.arange(points.shape[1])
    return ((points - at) ** 2 * 10.0 ** np.arange(points.shape[1])).sum(axis=1, keepdims=True)


def searched(sampler, function, generations):
    asked, losses = [], []
    for _ in range(generations):
        asked.append(sampler.ask())
        losses.append(function(asked[-1]))
        sampler.tell(losses[-1])
    return np.concatenate(asked), np.concatenate(losses)


def cma(**options):
    return CmaEs(np.full(4, 0.5), np.zeros(4), np.eye(4), 0.2, **({"seed": 3, "population": None} | options))


def test_cma_es_finds_the_least_and_stays_in_the_cube():
    points, losses = searched(cma(), bowl, 60)
    assert len(points) == 480 and losses.min() < 1e-4 < losses[0]
    assert points.min() >= 0 and points.max() <= 1


@pytest.mark.parametrize("make", [cma, lambda: Nsga2(np.full(4, 0.5), 0.2, 3, 8)])
def test_a_search_depends_on_its_seed_alone(make):
    function = bowl if make is cma else lambda p: np.column_stack([bowl(p), bowl(1 - p)])
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first, _ = searched(make(), function, 12)
    assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    again, _ = searched(make(), function, 12)
    assert first.tobytes() == again.tobytes()


def test_a_search_that_has_contracted_begins_again_with_more():
    sampler = cma()
    sizes = [len(searched(sampler, bowl, 1)[0]) for _ in range(150)]
    assert sizes[0] == 8 and 16 in sizes


def test_where_nothing_differs_generations_stay_within_bounds():
    sizes = {len(searched(sampler, lambda p: np.ones((len(p), 1)), 1)[0]) for sampler in [cma()] for _ in range(40)}
    assert 8 < max(sizes) <= 64


def test_the_step_of_a_whole_number_does_not_vanish():
    """Where the others contract, neighbouring cells are still tried."""
    sampler = CmaEs(np.full(2, 0.52), np.array([0.0, 0.02]), np.eye(2), 0.2, 5, None)
    points, _ = searched(sampler, lambda p: ((p - 0.5) ** 2).sum(axis=1, keepdims=True), 30)
    assert np.std(points[-12:, 0]) < 0.001 and np.std(points[-12:, 1]) > 0.002


def test_a_first_generation_changes_neighbours_together():
    """The mean has the step that is asked, the slope half of it, and differences of neighbours have little."""
    sampler = CmaEs(np.full(10, 0.5), np.zeros(10), smooth(10), 0.02, 4, 4000)
    points = sampler.ask() - 0.5
    assert np.std(points.mean(axis=1)) == pytest.approx(0.02, rel=0.05)
    modes = points @ smooth(10) / (smooth(10) ** 2).sum(axis=0)
    assert np.allclose(np.std(modes, axis=0), 0.02, rtol=0.08)
    assert np.abs(np.corrcoef(modes.T) - np.eye(10)).max() < 0.1
    assert np.std(points[:, 0] - points[:, 1]) < 0.02 < np.std(points[:, 0] - points[:, -1])


def test_nsga_ii_finds_the_front_of_two_bowls():
    """The best of both lie on the straight line between their lowest points."""
    ends = np.array([[0.2, 0.2, 0.2], [0.8, 0.8, 0.2]])
    points, losses = searched(Nsga2(np.full(3, 0.5), 0.2, 3, 20), lambda p: ((p[:, None] - ends) ** 2).sum(axis=2), 50)
    best = points[front(losses)]
    assert len(best) > 15 and np.ptp(best[:, 0]) > 0.4
    assert np.abs(best[:, 0] - best[:, 1]).max() < 0.1 and np.abs(best[:, 2] - 0.2).max() < 0.1


def test_a_front_has_what_nothing_is_better_than_and_its_knee():
    losses = np.array([[3.0, 0.0], [1.0, 1.0], [2.0, 2.0], [0.0, 4.0], [1.0, 1.0], [np.nan, -9.0], [0.0, 5.0]])
    assert front(losses).tolist() == [3, 1, 0]
    assert knee(losses[front(losses)]) == 1
    assert front(np.array([[2.0], [np.nan], [1.0], [1.0]])).tolist() == [2]
    assert front(np.full((2, 2), np.nan)).size == 0


class Bowl:
    """In place of the runs: the squares of the clearances' logarithms over 1 mm; some designs fail."""

    def __init__(self, fails=lambda case: False):
        self.fails, self.told = fails, []

    def runs(self, case):
        return {(1.0, 0): case}

    def losses(self, case):
        if self.fails(case):
            return [np.nan], "1 N: stalled"
        return [float((np.log(np.array(case.contacts.clearance) / 1e-3) ** 2).sum())], ""


class Recorder(CmaEs):
    told: list

    def tell(self, losses):
        self.told = [*getattr(self, "told", []), losses]
        super().tell(losses)


def spent(search):
    while search.tell_and_ask():
        search.runs()
    return search


def recorder(searched):
    return Recorder(searched.to_unit(searched.begin()), np.zeros(3), smooth(3), 0.2, 1, None)


@pytest.mark.slow
def test_a_search_spends_its_budget_and_keeps_the_best():
    small = plan("optimise.budget=200")
    search = spent(OptimumSearch(small, Bowl(), recorder(small), small.begin()))
    assert len(search.designs) == 200 and search.designs[0].case is small.base
    compared = search.compared()
    assert compared["case"] == 0 and search.losses()[compared["best"]] == search.losses().min() < 1e-3
    assert search.designs[compared["best"]].case.contacts.clearance == pytest.approx([1e-3] * 3, rel=0.05)
    assert [d.generation for d in search.designs[:9]] == [0] + [1] * 7 + [2]


def test_a_design_that_fails_or_cannot_be_is_told_to_be_worst_and_the_search_goes_on():
    small = plan("optimise.budget=60")
    sampler = recorder(small)
    search = OptimumSearch(small, Bowl(lambda case: case.contacts.clearance[0] > 2e-4), sampler, small.begin())
    impossible, design = [], search.plan.design

    def sometimes(self, values):
        if values[1] > 1.5e-4:
            impossible.append(values)
            raise CaseError([])
        return design(values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OptimiseCase, "design", sometimes)
        spent(search)
    failed = np.isnan(search.losses()[:, 0])
    assert len(search.designs) == 60 and 0 < len(impossible) < failed.sum() < 60
    assert {d.reason for d in search.designs if d.case and np.isnan(d.losses[0])} == {"1 N: stalled"}
    seen, place = search.losses()[0], 1
    for losses in sampler.told:
        own = search.losses()[place : place + len(losses)]
        seen, place = np.concatenate([seen, own[:, 0]]), place + len(losses)
        bad = np.isnan(own)
        assert np.array_equal(losses[~bad], own[~bad])
        assert np.all(losses[bad] > np.nanmax(seen))


def test_a_start_that_is_not_the_case_is_a_design_too():
    small = plan()
    search = OptimumSearch(small, Bowl(), recorder(small), small.begin([1e-3, 1e-3, 1e-3]))
    assert [d.case.contacts.clearance for d in search.designs][1] == pytest.approx([1e-3] * 3)
    assert len(search.runs()) == 2


def test_the_runs_of_a_design_are_its_amplitudes_times_what_scatters():
    """A scatter is that of [disorder] with the next seeds; the design itself is without."""
    objective = "optimise.objective=[{amplitudes=[2.0, 5.0]}, {measure='transmitted', amplitudes=[5.0, 9.0]}]"
    small = plan(objective, "optimise.samples=2", "disorder={seed=7, clearance={relative=0.01}}")
    runs = ObjectiveRuns.runs(Scarce(small), small.base)
    assert [*runs] == [(a, lot) for a in (2.0, 5.0, 9.0) for lot in (0, 1)]
    assert {run.drive.amplitude for run in runs.values()} == {2.0, 5.0, 9.0}
    drawn = Deviation(relative=0.01).draw(np.array(small.base.contacts.clearance), 8, "clearance")
    assert runs[5.0, 1].contacts.clearance == drawn.tolist() != small.base.contacts.clearance
    assert runs[5.0, 1].contacts.clearance == runs[2.0, 1].contacts.clearance != runs[5.0, 0].contacts.clearance


class Scarce(ObjectiveRuns):
    """Without ranks and files: what is known is given."""

    def __init__(self, plan, known=()):
        self.plan, self.recorded = plan, SimpleNamespace(records=dict(known))


def test_the_worst_or_the_mean_over_amplitudes_of_the_mean_over_what_scatters():
    objective = "optimise.objective=[{amplitudes=[2.0, 5.0]}, {measure='transmitted', goal='minimise', over='mean'}]"
    small = plan(objective, "optimise.samples=2", "disorder.clearance.relative=0.01", "drive.amplitude=5.0")
    share = {(2.0, 0): 0.1, (2.0, 1): 0.3, (5.0, 0): 0.5, (5.0, 1): 0.2}
    runs = ObjectiveRuns.runs(Scarce(small), small.base)
    known = {
        case_id(run): {"values": {"upper_share_at_end": share[key], "transmitted": 0.4}} for key, run in runs.items()
    }
    losses, reason = Scarce(small, known).losses(small.base)
    assert losses == pytest.approx([-0.2, 0.4]) and reason == ""
    known[case_id(runs[5.0, 1])] = {"reason": "stalled"}
    losses, reason = Scarce(small, known).losses(small.base)
    assert np.isnan(losses).all() and reason == "5 N: stalled"


@pytest.mark.parametrize("error", [MemoryError("Unable to allocate 1.00 TiB"), OSError(28, "full"), CaseError([])])
def test_a_run_that_memory_or_disk_was_short_for_has_no_record(tmp_path, error):
    """One that fails otherwise has: it is not made again."""
    asked = []

    def work(key):
        asked.append(key)
        raise {"stalls": RuntimeError("stalled"), "short": error}[key]

    for _ in range(2):
        runs = RecordedRuns("small-runs", tmp_path, MPI.COMM_SELF, StopRequest()).read()
        with pytest.raises(OSError, match=r"Unable|full|0 problem"):
            runs.make(["stalls", "short"], work, failures=True)
        known = RecordedRuns("small-runs", tmp_path, MPI.COMM_SELF, StopRequest()).read().records
        assert [*known] == ["stalls"] and known["stalls"]["reason"] == "stalled"
    assert asked == ["stalls", "short", "short"]
