"""A run that begins with the scaled samples of a linear run, up to its first contact, is the run from rest."""

from __future__ import annotations

import json

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr

from tests.conftest import assert_same_bits, datasets, small_case, with_sections
from vipetsc import spectra
from vipetsc.case import Case, Sweep
from vipetsc.dynamics import simulate
from vipetsc.dynamics.opening import Opening
from vipetsc.io.store import RunMemory
from vipetsc.parallel import StopRequest
from vipetsc.spectra import entropies
from vipetsc.studies import linear_history
from vipetsc.studies.analysis import analyse
from vipetsc.studies.linear_history import LinearHistory, MemberHistory, begins_linearly, history_bytes
from vipetsc.studies.linear_run import LinearRun
from vipetsc.studies.opening_entropies import OpeningEntropies
from vipetsc.studies.sweep import run_sweep

TABLE = {
    "name": "opens",
    "lattice": {"preset": "four-band", "cells": 40},
    "contacts": {"sites": [20, 26], "clearance": [2e-4, 3e-4]},
    "drive": {"cycles": 4, "cell": 3, "amplitude": 30.0},
    "time": {"end": 0.06, "rtol": 1e-9, "sample_interval": 1e-4, "engine": "propagator"},
}
COUNTS = ("steps", "substeps", "rejected", "landings", "switches", "episodes", "samples", "terms", "method")
FAR_DRIVE = {"drive": {"more": [{"waveform": "step", "amplitude": 0.1, "ramp": 1e-3, "cell": 36}]}}


def case_of(sections: dict) -> Case:
    """The case of the table updated by ``sections``, in which None removes a key of [drive]."""
    table = with_sections(TABLE, sections)
    table["drive"] = {key: value for key, value in table["drive"].items() if value is not None}
    return Case.from_table(table)


def run_of(case: Case, begins: bool):
    """The dataset and the statistics of a run, and the number of samples that it takes from a linear run.

    A run that ``begins`` linearly takes the samples before the first contact; any other takes none.
    """
    opening = LinearHistory.of(case, MPI.COMM_SELF, StopRequest()).opening(case) if begins else None
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory, opening=lambda: opening)
    assert result.complete
    return memory.dataset, result.statistics, opening.samples if opening else 0


@pytest.fixture(
    scope="module",
    params=[
        {},
        {"drive": {"amplitude": -30.0}},
        {"contacts": {"law": "bilinear", "restitution": 0.8}},
        {"lattice": {"damping": {"loss": {"1": 0.01, "2": 0.02}}}},
        {"output": {"points": [{"name": "a", "cell": 12, "mass": 1}, {"name": "b", "cell": 26, "mass": 2}]}},
        {"output": {"fields": ["velocity"], "window": [5, 33], "every": 4, "stride": 3, "forces": True}},
        FAR_DRIVE,
        {"drive": {"end": "left", "amplitude": 1e-2, "cell": None}},
    ],
    ids=["plain", "negative", "bilinear", "damped", "points", "thin", "two drives", "wall"],
)
def pair(request):
    """The case, its run from rest, and its run that begins with samples of the linear run."""
    case = case_of(request.param)
    return case, run_of(case, begins=False), run_of(case, begins=True)


def test_the_contacts_are_those_of_the_whole_run(pair):
    """A run that begins linearly has the contacts of the run from rest, and the same counts of steps."""
    case, (whole, statistics, _), (begun, numbers, samples) = pair
    first = whole["impacts/onset"].values.min()
    assert whole.sizes["episode"] > 3
    # Checkpoints are 64 samples apart. The run begins with the last one before the wave is near a stop.
    assert 0 < first / case.time.sample_interval - samples < 64 + 40

    assert {key: numbers[key] for key in COUNTS} == {key: statistics[key] for key in COUNTS}
    np.testing.assert_allclose(begun["impacts/onset"].values, whole["impacts/onset"].values, rtol=1e-9)
    for name in ("site", "side"):
        np.testing.assert_array_equal(begun[f"impacts/{name}"].values, whole[f"impacts/{name}"].values)
    np.testing.assert_allclose(begun["impacts/loss"].values, whole["impacts/loss"].values, rtol=1e-6)


def test_every_variable_is_that_of_the_whole_run(pair):
    """Every variable of a run that begins linearly is that of the run from rest, to 1e-9 of its largest value."""
    _, (whole, _, _), (begun, _, samples) = pair
    assert begun.variables.keys() == whole.variables.keys()
    for name, variable in whole.variables.items():
        found = begun[name]
        assert found.dims == variable.dims
        if variable.dtype == object:
            assert found.values.tolist() == variable.values.tolist()
        elif not name.startswith("impacts/"):
            # Dissipated energies may be small, so that errors of all energies are relative to the work.
            whole_of = whole["energy/work"] if name.startswith("energy/") else variable
            scale = np.abs(whole_of.values).max(initial=1e-300)
            np.testing.assert_allclose(found.values, variable.values, rtol=0, atol=1e-9 * scale, err_msg=name)

    # Before the contacts both runs have the same linear motion, up to rounding.
    before = slice(samples)
    for name in ("energy/kinetic", "energy/spring", "energy/work"):
        values = whole[name].values[before]
        np.testing.assert_allclose(begun[name].values[before], values, rtol=0, atol=1e-12 * np.abs(values).max())


def test_the_ledger_closes(pair):
    """The ledger closes to 1e-9 of the work, including the work that the drive did in the linear run."""
    _, _, (begun, numbers, _) = pair
    kinetic, spring, contact, dissipated, work = (
        begun[f"energy/{name}"].values for name in ("kinetic", "spring", "contact", "dissipated", "work")
    )
    if "energy/dissipated_by_damping" in begun:
        dissipated = dissipated + begun["energy/dissipated_by_damping"].values
    error = np.abs(work - dissipated - kinetic - spring - contact).max() / np.abs(work).max()
    assert numbers["ledger_error"] < 1e-9
    assert numbers["ledger_error"] == pytest.approx(error, rel=0.1)
    assert numbers["work"] == begun["energy/work"].values[-1]


def test_a_run_that_may_touch_at_once_begins_at_rest():
    """A run begins at rest if no checkpoint lies before a contact: next to a strong drive, or with stops that touch."""
    history = LinearHistory.of(case_of({}), MPI.COMM_SELF, StopRequest())
    assert history.opening(case_of({})) is not None
    assert history.opening(case_of({"drive": {"amplitude": 3e3}, "contacts": {"sites": [3, 26]}})) is None
    assert history.opening(case_of({"contacts": {"clearance": 0.0, "restitution": 1.0, "side": "plus"}})) is None


@pytest.fixture(scope="module")
def between_samples() -> dict:
    """Changes of the table after which the linear wave passes the clearance of a site between two samples alone."""
    clear = {"contacts": {"sites": [9], "clearance": 1.0}, "drive": {"cycles": 1}, "time": {"sample_interval": 8e-4}}
    case = case_of(clear)
    history = LinearHistory.of(case, MPI.COMM_SELF, StopRequest())
    in_samples = LinearRun.of(history.run, history.statistics, sites=(), names=()).reached(case).max()

    # In a run with finer samples, which has no contact at a clearance of 1 m.
    run, _, _ = run_of(case_of(clear | {"time": {"sample_interval": 5e-5}}), begins=False)
    cell = case.model().chain.cell
    u = run["displacement"].values[:, 8]
    between = np.abs(u[:, cell.resonator] - u[:, cell.host]).max()
    assert between > 1.01 * in_samples
    return clear | {"contacts": {"sites": [9], "clearance": float(np.sqrt(in_samples * between))}}


def test_a_run_begins_before_a_contact_that_no_sample_shows(between_samples, monkeypatch):
    """A run that begins linearly has the contact that its linear wave makes between two samples."""
    monkeypatch.setattr(linear_history, "STATES_EVERY", 8)
    case = case_of(between_samples)
    whole, _, _ = run_of(case, begins=False)
    begun, _, samples = run_of(case, begins=True)
    assert samples > 0
    assert begun.sizes["episode"] == whole.sizes["episode"] > 0


def test_a_member_with_a_contact_that_no_sample_shows_is_simulated(between_samples):
    """A member whose linear wave passes its clearance between two samples has its contact: it is not scaled."""
    table = with_sections(TABLE, between_samples)
    result = run_sweep(Sweep.from_table(table | {"sweep": {"drive": {"amplitude": [30.0]}, "measures": ["transfer"]}}))
    assert result.dataset["contact_episodes"].item() > 0


@pytest.mark.parametrize(
    ("sweep", "sections", "begins"),
    [
        ({"drive": {"amplitude": [1.0, 2.0, 3.0]}}, {}, True),
        ({"drive": {"amplitude": [1.0, 2.0]}}, {}, False),
        ({"contacts": {"clearance": [2e-4, 3e-4]}, "drive": {"amplitude": [1.0, 2.0]}}, {}, True),
        # Each number of cycles has a linear run of its own.
        ({"drive": {"cycles": [3, 4, 5]}}, {}, False),
        (
            {"zip": [["drive.amplitude", "drive.cycles"]], "drive": {"amplitude": [1, 2, 3], "cycles": [3, 4, 5]}},
            {},
            False,
        ),
        ({"drive": {"amplitude": [1.0, 2.0, 3.0]}}, FAR_DRIVE, False),
        ({"disorder": {"seed": {"count": 4}}}, {"disorder": {"clearance": {"relative": 0.1}}}, True),
        ({"disorder": {"seed": {"count": 4}}}, {"disorder": {"masses": {"relative": 0.01}}}, False),
        # Contacts that join cells are a part of the linear run.
        ({"drive": {"amplitude": [1.0, 2.0, 3.0]}}, {"contacts": {"next_cell": True}}, False),
    ],
)
def test_members_begin_from_a_linear_run_that_several_have_in_common(sweep, sections, begins):
    """Members begin linearly if at least three of them differ only in what leaves the linear run as it is."""
    plan = Sweep.from_table(with_sections(TABLE, sections) | {"sweep": sweep})
    assert begins_linearly(plan, plan.case(0)) == begins


def test_the_bytes_of_a_history_are_those_of_its_fields():
    """What is counted against the limit of memory is the size of the displacements and velocities of a run."""
    case = small_case(time={"end": 0.002})
    memory = RunMemory()
    simulate(case, memory)
    run = memory.dataset
    assert history_bytes(case) == run["displacement"].nbytes + run["velocity"].nbytes
    assert history_bytes(case, fields=1) == run["velocity"].nbytes


@pytest.mark.parametrize(("room", "simulated"), [(3, 3), (2, 6)])
def test_histories_of_velocities_fit_twice_into_the_memory_of_whole_ones(monkeypatch, room, simulated):
    """Three linear histories are simulated once each if the memory holds three, and again and again if it holds two.

    With room for two, a third history replaces the first one, which its members then simulate again.
    """
    sweep = {"drive": {"cycles": [3, 4, 5], "amplitude": [30.0, 31.0, 32.0]}, "measures": ["transfer"]}
    plan = Sweep.from_table(TABLE | {"sweep": sweep})
    size = history_bytes(plan.case(0), fields=1)
    monkeypatch.setattr(linear_history, "MOST_BYTES", room * size)
    cases = []
    of = LinearHistory.of

    def counted(case: Case, *others) -> LinearHistory:
        cases.append(case)
        return of(case, *others)

    monkeypatch.setattr(LinearHistory, "of", counted)
    assert run_sweep(plan).complete
    assert len(cases) == simulated


@pytest.mark.slow
def test_a_member_has_the_same_bits_in_every_sweep_and_alone(tmp_path):
    """A member has the same bits with other members, with stored fields, and as a run of its own."""
    amplitudes = [1.0, 30.0, 40.0, 50.0]
    folders = {"all": amplitudes, "some": amplitudes[1:], "fields": amplitudes[1:]}
    records = {}
    for name, values in folders.items():
        sweep = {"drive": {"amplitude": values}, "measures": ["transfer", "entropy"], "fields": name == "fields"}
        plan = Sweep.from_table(TABLE | {"sweep": sweep})
        assert run_sweep(plan, tmp_path / name).complete
        lines = (tmp_path / name / "members.jsonl").read_text().splitlines()
        members = [json.loads(line) for line in lines]
        records[name] = {row["key"]: row for row in members if row["kind"] == "member"}

    # Sweeps of the same base case give the same names to equal members.
    for name, row in records["some"].items():
        other = records["all"][name]
        assert row["measures"] == other["measures"]
        assert row["statistics"]["dissipated"] == other["statistics"]["dissipated"]
        stored = records["fields"][name]["measures"]
        assert row["measures"]["entropy/history"] == stored["entropy/history"]

    name = plan.ids()[0]
    case = plan.case(0)
    simulate(case, tmp_path / "alone", opening=MemberHistory(plan, case, MPI.COMM_SELF, StopRequest()).opening)
    alone = datasets(tmp_path / "alone" / "run.h5")
    assert_same_bits(alone, datasets(tmp_path / "fields" / name / "run.h5"))
    assert records["some"][name]["statistics"]["work"] == alone["energy/work"][-1]
    # The agreement is not trivial, as a run from rest differs in the last bits.
    simulate(case, tmp_path / "rest")
    assert datasets(tmp_path / "rest" / "run.h5")["velocity"].tobytes() != alone["velocity"].tobytes()


@pytest.mark.slow
def test_entropies_before_the_first_contact_are_those_of_the_linear_run(monkeypatch):
    """Entropies of the linear samples are computed once for all members, which transform only their other snapshots."""
    sweep = {"drive": {"amplitude": [30.0, 40.0, 50.0]}, "measures": ["entropy"]}
    plan = Sweep.from_table(TABLE | {"sweep": sweep})
    transformed = []
    compute = entropies.local_entropy

    def counted(velocity: np.ndarray, stride: int = 1) -> entropies.LocalEntropy:
        transformed.append(len(velocity))
        return compute(velocity, stride)

    monkeypatch.setattr(entropies, "local_entropy", counted)
    monkeypatch.setattr(spectra, "local_entropy", counted)
    results = run_sweep(plan)
    assert results.complete

    # The linear run transforms all of its snapshots, and has none of its own: only samples between them, in which the
    # largest weight is sought.
    snapshots = transformed[0]
    assert transformed[1] <= entropies.STRONGEST < 0.1 * snapshots
    assert max(transformed[2:]) < 0.8 * snapshots

    data = results.dataset
    for number in range(3):
        run, _, _ = run_of(plan.case(number), begins=False)
        alone = analyse(run, ["entropy"], arrival=float(data["entropy/start"][number]))
        for name in ("energy_weighted", "masked", "joint", "error", "history"):
            expected = alone[f"entropy/{name}"].values
            assert data[f"entropy/{name}"][number].values == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_first_entropies_are_those_of_the_scaled_motion():
    """First entropies scale with the motion: H does not depend on the amplitude, and W is proportional to its square.

    The entropies of the linear run are computed once and stay unscaled for other members.
    """
    velocity = np.random.default_rng(3).standard_normal((41, 24, 2))
    computed: dict = {}
    for factor in (-3.0, 0.7):
        first = OpeningEntropies(velocity, computed, samples=22, factor=factor).first(dof=1, every=4, stride=2)
        expected = entropies.local_entropy(factor * velocity[:22:4, :, 1], stride=2)
        assert first.local == pytest.approx(expected.local, rel=1e-9, abs=1e-12)
        assert first.weight == pytest.approx(expected.weight, rel=1e-12)
    assert len(computed) == 1


def test_a_checkpoint_is_scaled_by_what_its_numbers_are():
    """Scaling a checkpoint multiplies motion by the factor and energies by its square, and leaves counts."""
    work = np.array([(0, 5.0)], dtype=[("number", np.int64), ("energy", float)])
    part = {"samples": np.array(7), "cells": np.ones((2, 4)), "work": work, "ledger/worst": np.array(2.0)}
    (scaled,) = Opening(xr.Dataset(), [part], -3.0).checkpoint()
    assert scaled["samples"] == 7
    assert (scaled["cells"] == -3.0).all()
    assert scaled["work"].tolist() == [(0, 45.0)]
    assert scaled["ledger/worst"] == 18.0
    # The original checkpoint stays as it is for other members.
    assert part["work"].tolist() == [(0, 5.0)]
