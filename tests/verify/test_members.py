"""Members of a sweep are scaled from a linear run where no contact can close, and simulated otherwise."""

import os

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets
from vipetsc.case import Case, Sweep
from vipetsc.dynamics import simulate
from vipetsc.io.read import open_ensemble
from vipetsc.parallel import StopRequest
from vipetsc.studies.ensemble import COMPLETE, SCALED
from vipetsc.studies.linear_run import MEMBERS, linear_case, linear_name
from vipetsc.studies.reanalysis import reanalyse_folders
from vipetsc.studies.recorded_runs import RecordPaths
from vipetsc.studies.sweep import run_sweep
from vipetsc.studies.sweep_runs import NeededRun, SweepRuns

TABLE = {
    "name": "margin",
    "lattice": {"preset": "four-band", "cells": 24},
    "contacts": {"sites": [8, 13], "clearance": [2e-4, 3e-4]},
    "drive": {"cycles": 4, "cell": 3},
    "time": {"end": 0.08, "rtol": 1e-9},
}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """The margins (6,), the ensemble and the folder of a sweep over amplitudes.

    At these amplitudes the linear wave reaches 0.6, 0.85, 1.02, 1.1, 1.25 and 3 times the clearance.
    """
    folder = tmp_path_factory.mktemp("members")

    # The linear run that the sweep itself makes measures which part of the clearance the wave of 1 N reaches.
    case = Case.from_table(TABLE | {"drive": TABLE["drive"] | {"amplitude": 1.0}})
    plan = Sweep.from_table(TABLE | {"sweep": {"drive": {"amplitude": [1.0]}}})
    runs = SweepRuns(plan, folder, MPI.COMM_SELF, StopRequest())
    runs.make_linear({linear_name(case): NeededRun(linear_case(case), [])})
    reached = runs.linear[linear_name(case)].reached(case).max()

    margins = np.array([0.6, 0.85, 1.02, 1.1, 1.25, 3.0])
    table = TABLE | {"sweep": {"drive": {"amplitude": (margins / reached).tolist()}}}
    assert run_sweep(Sweep.from_table(table), folder / "sweep").complete
    return margins, open_ensemble(folder / "sweep"), folder / "sweep"


def test_a_member_is_simulated_unless_its_wave_stays_well_inside_the_clearance(sweep):
    margins, ensemble, _ = sweep
    assert ensemble["status"].values.tolist() == np.where(margins < 0.9, SCALED, COMPLETE).tolist()

    # A wave that reaches the clearance has contacts, which scaling would lose.
    touching = margins > 1.05
    assert (ensemble["contact_episodes"].values[touching] > 0).all()
    assert (ensemble["contact_episodes"].values[margins < 1] == 0).all()
    assert (ensemble["dissipated_fraction"].values[touching] > 0).all()


def test_a_member_whose_fields_are_thinned_is_measured_from_all(tmp_path):
    """A member's file has the thinned fields that the case asks for, and its analysis is that of all samples."""
    table = TABLE | {"sweep": {"fields": True, "drive": {"amplitude": [60.0]}}}
    thin = {"fields": ["velocity"], "window": [5, 9], "every": 4, "stride": 3}
    assert run_sweep(Sweep.from_table(table), tmp_path / "all").complete
    assert run_sweep(Sweep.from_table(table | {"output": thin}), tmp_path / "thin").complete

    whole = next((tmp_path / "all").glob("*/run.h5")).parent
    kept = next((tmp_path / "thin").glob("*/run.h5")).parent
    assert {path.name for path in kept.iterdir()} == {"run.h5", "analysis.h5"}
    assert_same_bits(datasets(whole / "analysis.h5"), datasets(kept / "analysis.h5"))

    everything = datasets(whole / "run.h5")
    found = datasets(kept / "run.h5")
    assert "displacement" not in found
    assert found["cell"].tolist() == [5, 9]
    np.testing.assert_array_equal(found["velocity"], everything["velocity"][::3, [4, 8]])
    np.testing.assert_array_equal(found["field_time"], everything["time"][::3])
    np.testing.assert_array_equal(found["energy/work"], everything["energy/work"])

    written = (kept / "analysis.h5").read_bytes()
    assert [path.name for path in reanalyse_folders([tmp_path / "thin"], MPI.COMM_SELF)] == ["ensemble.h5"]
    assert (kept / "analysis.h5").read_bytes() == written

    os.truncate(kept / "run.h5", 300)
    again = run_sweep(Sweep.from_table(table | {"output": thin}), tmp_path / "thin")
    assert again.computed == 1
    assert "run.h5 cannot be read" in again.warnings[0]
    assert_same_bits(found, datasets(kept / "run.h5"))


def test_modal_energies_of_members_are_what_work_and_losses_leave(sweep):
    """Modal energies at the end of a member sum to the work less the losses, if no site is in contact then."""
    margins, ensemble, _ = sweep
    energy = ensemble["bands/modal_energy"]
    work = ensemble["work"].values
    assert energy.attrs["parts"] == ensemble["bands/share"].attrs["parts"]
    assert energy.sizes["part"] == 8

    left = work * (1 - ensemble["dissipated_fraction"].values)
    # At larger amplitudes a site may be in contact at the end.
    apart = margins < 1.2
    assert energy.values.sum(axis=1)[apart] == pytest.approx(left[apart], rel=1e-6)

    upper = energy.values[:, [4, 6]].sum(axis=1) / work
    assert ensemble["upper_share_at_end"].values == pytest.approx(upper, rel=1e-12)


OVERLAPPING = {
    "name": "overlap",
    "lattice": {
        "cells": 16,
        "cell": {
            "masses": [0.01, 0.004],
            "springs": [
                {"start": 1, "end": 1, "stiffness": 2e4, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 6e3},
                {"start": 2, "end": 2, "stiffness": 1.0, "next_cell": True},
            ],
            "contact": [1, 2],
        },
    },
    "contacts": {"sites": [6], "clearance": 1e-4, "stiffness": 1e6},
    "drive": {"cycles": 3, "frequency": 700.0, "amplitude": 20.0},
    "time": {"end": 0.02},
    "sweep": {"measures": ["transfer"], "lattice": {"cell": {"springs[3].stiffness": [1.0, 1000.0, 1.1]}}},
}


def test_members_whose_bands_overlap_differently_keep_their_parts():
    """A soft spring leaves a gap between two bands, a stiff one makes them one: each member has the parts it has."""
    plan = Sweep.from_table(OVERLAPPING)
    ensemble = run_sweep(plan).dataset

    parts = list(ensemble["bands/share"].attrs["parts"])
    assert set(parts) == {"band 1", "gap 1", "band 2", "band 1+2", "above"}
    assert parts[-1] == "above"
    share = {part: ensemble["bands/share"].isel(part=number).values for number, part in enumerate(parts)}
    for part, values in share.items():
        own = [part in ("band 1+2", "above"), part in ("band 1", "gap 1", "band 2", "above")]
        assert np.isfinite(values).tolist() == [own[1], own[0], own[1]]
    for cut in (["band 1", "gap 1", "band 2", "above"], ["band 1+2", "above"]):
        assert sorted(cut, key=parts.index) == cut
    # The energies of a member's own parts are all of its energy; a closed contact has less than 1 % of it.
    assert ensemble["bands/share"].sum("part").values == pytest.approx(1.0)
    energy = ensemble["bands/modal_energy"].sum("part").values
    assert energy == pytest.approx(ensemble["work"].values * (1 - ensemble["dissipated_fraction"].values), rel=1e-2)


SHORT_STEPS = TABLE | {"time": TABLE["time"] | {"sample_interval": 1e-4, "engine": "propagator"}}


def test_a_member_has_the_same_bits_in_every_sweep_and_alone(tmp_path):
    """A member has the same bits with other members, with stored fields, and as a run of its own."""
    amplitudes = [1.0, 30.0, 40.0]
    records = {}
    for name, values in {"all": amplitudes, "one": amplitudes[1:2], "fields": amplitudes[1:]}.items():
        sweep = {"drive": {"amplitude": values}, "measures": ["transfer", "entropy"], "fields": name == "fields"}
        plan = Sweep.from_table(SHORT_STEPS | {"sweep": sweep})
        assert run_sweep(plan, tmp_path / name).complete
        rows = [record for _, record, _ in RecordPaths(tmp_path / name, MEMBERS).read()]
        records[name] = {row["key"]: row for row in rows if row["kind"] == "member"}

    # Sweeps of the same base case give the same names to equal members.
    (member,) = records["one"]
    alone = records["one"][member]
    for name in ("all", "fields"):
        found = records[name][member]
        assert found["statistics"]["work"] == alone["statistics"]["work"]
        assert found["measures"]["entropy/history"] == alone["measures"]["entropy/history"]
    assert records["all"][member]["measures"] == alone["measures"]

    simulate(plan.case(0), tmp_path / "alone")
    assert_same_bits(datasets(tmp_path / "alone" / "run.h5"), datasets(tmp_path / "fields" / member / "run.h5"))


@pytest.fixture(scope="module")
def between_samples():
    """Return a clearance that a linear wave passes between two samples 0.8 ms apart, and not at any sample."""
    far = {"contacts": {"sites": [9], "clearance": 1.0}, "drive": TABLE["drive"] | {"cycles": 1, "amplitude": 30.0}}

    def largest(interval: float) -> float:
        case = Case.from_table(SHORT_STEPS | far | {"time": SHORT_STEPS["time"] | {"sample_interval": interval}})
        run = simulate(case, comm=MPI.COMM_SELF).dataset
        cell = case.model().chain.cell
        u = run["displacement"].values[:, 8]
        return np.abs(u[:, cell.resonator] - u[:, cell.host]).max()

    at_samples = largest(8e-4)
    between = largest(5e-5)
    assert between > 1.01 * at_samples
    return far | {"contacts": {"sites": [9], "clearance": float(np.sqrt(at_samples * between))}}


def test_a_member_with_a_contact_that_no_sample_shows_is_simulated(between_samples):
    """A member whose linear wave passes its clearance between two samples has its contact: it is not scaled."""
    table = SHORT_STEPS | between_samples | {"time": SHORT_STEPS["time"] | {"sample_interval": 8e-4}}
    sweep = {"drive": {"amplitude": [30.0]}, "measures": ["transfer"]}
    assert run_sweep(Sweep.from_table(table | {"sweep": sweep})).dataset["contact_episodes"].item() > 0
