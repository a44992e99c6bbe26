"""The section [optimise], designs as points of the unit cube, searches, and objectives from prescribed runs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import search_table
from vipetsc.case import CaseError, case_id
from vipetsc.case.disorder import Deviation
from vipetsc.case.optimise import OptimiseCase
from vipetsc.studies.objective import Judgement, ObjectiveRuns, _energy_beyond
from vipetsc.studies.optimum_search import OptimumSearch
from vipetsc.studies.sampler import CmaEs, Nsga2, smooth

BOUNDS = {"budget": 12, "variables": {"clearance": [1e-5, 1e-2]}}
TABLE = search_table(40, [10, 20, 30], contacts={"clearance": {"first": 2e-4, "last": 1e-4}}, optimise=BOUNDS)


@pytest.mark.parametrize(("ends", "beyond"), [("fixed", 9.0), ("periodic", np.nan)])
def test_nothing_lies_beyond_the_last_site_of_a_ring(ends, beyond):
    """The energy of masses that move beyond the last site is that of a lattice with ends; a ring has no such cells."""
    model = OptimiseCase.from_table(TABLE | {"lattice": TABLE["lattice"] | {"ends": ends}}).base.model()
    masses = np.asarray(model.chain.cell.masses)
    velocity = np.zeros((40, 4))
    # Two masses before the last site, which is in the 30th cell, and one behind it.
    velocity[[3, 20, 35], 0] = np.sqrt(2 * np.array([1.0, 4.0, 9.0]) / masses[0])
    assert _energy_beyond(model, np.zeros((40, 4)), velocity) == pytest.approx(beyond, nan_ok=True)


def plan(*changes: str) -> OptimiseCase:
    """Return the search of ``TABLE`` with some keys changed."""
    return OptimiseCase.from_table(TABLE, changes)


def test_the_start_is_the_case():
    """The first design is the case itself, and its values survive the map into the unit cube and back."""
    search = plan("optimise.variables.sites=[2, 39]", "optimise.variables.restitution=[0.0, 1.0]")

    values = search.begin()

    assert case_id(search.design(values)) == case_id(search.base)
    # Bounds are logarithms: values return to rounding, not to the bit.
    assert np.allclose(search.space.from_unit(search.space.to_unit(values)), values, rtol=1e-12)


def test_a_profile_is_log_spaced_and_a_cell_takes_its_masses_and_springs():
    """Values become a logarithmic profile of clearances and a cell's masses and springs; all else stays."""
    bounds = "{profile=[1e-5, 1e-2], masses={3=[1e-3, 1e-2]}, springs={4=[1e2, 1e4]}}"
    search = plan(f"optimise.variables={bounds}")
    names = [variable.name for variable in search.variables()]
    assert names == ["first clearance", "last clearance", "mass 3", "spring 4"]

    case = search.design(np.array([4e-4, 1e-4, 4e-3, 1500.0]))

    assert case.contacts.clearance == pytest.approx([4e-4, 2e-4, 1e-4])
    assert case.contacts.stiffness == search.base.contacts.stiffness
    cell = case.lattice.unit_cell()
    given_cell = search.base.lattice.unit_cell()
    assert cell.masses == (*given_cell.masses[:2], 4e-3, given_cell.masses[3])
    assert cell.springs[3].stiffness == 1500.0
    assert cell.springs[:3] == given_cell.springs[:3]
    assert cell.host == given_cell.host
    assert cell.resonator == given_cell.resonator
    # The wave is that of the new cell, in the same band at its fastest.
    assert case.drive.frequency != search.base.drive.frequency


@settings(max_examples=60)
@given(
    # Points outside the cube are included, since samplers may step over its edge.
    point=st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=3),
    # Bounds are the whole lattice, exactly three cells, three cells at its end, and a part of it.
    bounds=st.sampled_from([(1, 40), (7, 9), (38, 40), (5, 30)]),
)
def test_sites_are_distinct_in_order_and_within_their_bounds(point, bounds):
    """Any point near the unit cube is three sites in ascending order within the bounds."""
    low, high = bounds
    search = plan("optimise.variables.clearance=", f"optimise.variables.sites=[{low}, {high}]")

    cells = search.space.from_unit(np.array(point))

    assert np.all(np.diff(cells) >= 1)
    assert cells[0] >= low
    assert cells[-1] <= high
    assert search.design(cells).contacts.sites == cells.astype(int).tolist()


class Bowl:
    """An objective without runs: the sum of log(clearance/1 mm)^2 over the sites; designs with ``fails(case)`` fail."""

    def __init__(self, fails=lambda case: False):
        self.fails = fails

    def runs(self, case):
        # A design has one run, at 1 N and with the first sample.
        return {(1.0, 0): case}

    def judge(self, case):
        if self.fails(case):
            return Judgement([np.nan], [], reason="1 N: stalled")
        logarithms = np.log(np.array(case.contacts.clearance) / 1e-3)
        return Judgement([float((logarithms**2).sum())], [])


class Recorder(CmaEs):
    """CMA-ES that keeps the losses and the excess that it is given."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.generations = []

    def know_start(self, losses, excess):
        self.started = losses.tolist(), excess
        super().know_start(losses, excess)

    def tell(self, losses, excess):
        self.generations.append((losses, excess))
        super().tell(losses, excess)


def spend(search):
    """Go on with a search until its budget is spent."""
    while search.tell_and_ask():
        search.runs()


def recorder(plan):
    """Return a sampler of three clearances that begins with those of the case."""
    return Recorder(plan.space.to_unit(plan.begin()), np.zeros(3), smooth(3), 0.2, seed=1, population=None)


def test_a_search_spends_its_budget_and_keeps_the_best():
    """A search makes as many designs as its budget allows, the case first, and compares the best one with it."""
    # Enough for three variables to come within 5 % of the least value.
    small = plan("optimise.budget=200")
    search = OptimumSearch(small, Bowl(), recorder(small), small.begin())

    spend(search)

    assert len(search.designs) == 200
    # The first design is the same object, not a case built from its values.
    assert search.designs[0].case is small.base
    compared = search.compared()
    assert compared["case"] == 0
    assert search.losses()[compared["best"]] == search.losses().min() < 1e-3
    assert search.designs[compared["best"]].case.contacts.clearance == pytest.approx([1e-3] * 3, rel=0.05)
    # The case, then generations of seven: the number that CMA-ES takes for three variables.
    assert [design.generation for design in search.designs[:9]] == [0] + [1] * 7 + [2]


def fails_where_first_clearance_is_large(case):
    return case.contacts.clearance[0] > 2e-4


def test_failed_and_impossible_designs_are_reported_and_the_search_goes_on():
    """The sampler receives losses unchanged; failed and impossible designs miss the constraints by any amount."""
    small = plan("optimise.budget=60")
    sampler = recorder(small)
    search = OptimumSearch(small, Bowl(fails_where_first_clearance_is_large), sampler, small.begin())
    impossible = []
    design = search.plan.design

    def impossible_where_second_clearance_is_large(self, values):
        if values[1] > 1.5e-4:
            impossible.append(values)
            raise CaseError([])
        return design(values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OptimiseCase, "design", impossible_where_second_clearance_is_large)
        spend(search)

    failed = np.isnan(search.losses()[:, 0])
    assert len(search.designs) == 60
    # Some designs are impossible, others fail, and others succeed.
    assert 0 < len(impossible) < failed.sum() < 60
    reasons = {design.reason for design in search.designs if design.case and np.isnan(design.losses[0])}
    assert reasons == {"1 N: stalled"}

    # Design 0 is the case, which belongs to no generation.
    first = 1
    for losses, excess in sampler.generations:
        last = first + len(losses)
        np.testing.assert_array_equal(losses, search.losses()[first:last])
        assert np.array_equal(excess, np.where(np.isnan(losses[:, 0]), np.inf, 0.0))
        first = last


def test_a_start_that_is_not_the_case_is_a_design_too():
    """Where the search begins elsewhere, both the case and its start are run."""
    small = plan()

    search = OptimumSearch(small, Bowl(), recorder(small), small.begin([1e-3, 1e-3, 1e-3]))

    assert search.designs[1].case.contacts.clearance == pytest.approx([1e-3] * 3)
    assert len(search.runs()) == 2
    # The sampler is told of the start, not of the case.
    assert search.tell_and_ask()
    assert search.sampler.started == ([search.designs[1].losses[0]], 0.0)
    assert search.designs[1].losses != search.designs[0].losses


@pytest.mark.parametrize("clearance", [(), (1.1e-3, 1.3e-3, 1.7e-3)])
def test_the_start_that_a_sampler_asks_for_has_no_runs_of_its_own(clearance):
    """NSGA-II has the start in its first generation: its values are those of the start to the bit, as are its runs."""
    small = plan()
    start = small.begin(clearance)
    sampler = Nsga2(small.space.to_unit(start), step=0.2, seed=1, population=8, objectives=1)
    search = OptimumSearch(small, Bowl(), sampler, start)
    tried = len(search.designs)

    assert search.tell_and_ask()

    begun, asked = search.designs[tried - 1 : tried + 1]
    assert asked.generation == 1
    np.testing.assert_array_equal(asked.values, start)
    assert case_id(asked.case) == case_id(begun.case)


def test_the_runs_of_a_design_are_its_amplitudes_times_what_scatters():
    """A design is run at each amplitude with each sample of scatter, drawn as [disorder] with successive seeds."""
    objective = "optimise.objective=[{amplitudes=[2.0, 5.0]}, {measure='transmitted', amplitudes=[5.0, 9.0]}]"
    small = plan(objective, "optimise.samples=2", "disorder={seed=7, clearance={relative=0.01}}")

    runs = ObjectiveRuns.runs(GivenRecords(small), small.base)

    # The two objectives have three different amplitudes, each with two samples.
    assert [*runs] == [(2.0, 0), (2.0, 1), (5.0, 0), (5.0, 1), (9.0, 0), (9.0, 1)]
    assert {run.drive.amplitude for run in runs.values()} == {2.0, 5.0, 9.0}
    clearance = {key: run.contacts.clearance for key, run in runs.items()}
    # The second sample has the seed after that of the case.
    drawn = Deviation(relative=0.01).draw(np.array(small.base.contacts.clearance), 8, "clearance")
    assert clearance[5.0, 1] == drawn.tolist() != small.base.contacts.clearance
    # A sample has the same lattice at all amplitudes, so that these can be compared.
    assert clearance[5.0, 1] == clearance[2.0, 1] != clearance[5.0, 0]


class GivenRecords(ObjectiveRuns):
    """The runs of an objective with prescribed records, without ranks and files."""

    def __init__(self, plan, records=()):
        self.plan = plan
        self.recorded = SimpleNamespace(records=dict(records))


def test_the_worst_or_the_mean_over_amplitudes_of_the_mean_over_what_scatters():
    """A loss is the mean over samples, then the worst or the mean over amplitudes; one failed run makes it NaN."""
    objective = "optimise.objective=[{amplitudes=[2.0, 5.0]}, {measure='transmitted', goal='minimise', over='mean'}]"
    small = plan(objective, "optimise.samples=2", "disorder.clearance.relative=0.01", "drive.amplitude=5.0")
    upper = {(2.0, 0): 0.1, (2.0, 1): 0.3, (5.0, 0): 0.5, (5.0, 1): 0.2}
    runs = ObjectiveRuns.runs(GivenRecords(small), small.base)
    records = {}
    for key, run in runs.items():
        records[case_id(run)] = {"values": {"upper_share_at_end": upper[key], "transmitted": 0.4}}

    losses, _, _, reason = GivenRecords(small, records).judge(small.base)
    # The means are 0.2 at 2 N and 0.35 at 5 N; the smaller one counts. A measure to maximise is a negative loss.
    assert losses == pytest.approx([-0.2, 0.4])
    assert reason == ""

    # One of four runs fails: a mean over the others would favour designs that fail.
    records[case_id(runs[5.0, 1])] = {"reason": "stalled"}
    losses, _, _, reason = GivenRecords(small, records).judge(small.base)
    assert np.isnan(losses).all()
    assert reason == "5 N: stalled"
