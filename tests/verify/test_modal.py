"""Modal energies of runs sum to the energy, change only at contacts and by the drive, and balance with the losses."""

import numpy as np
import pytest

from tests.conftest import run_of, small_case
from vipetsc import Case
from vipetsc.figures.modal import MovedEnergies
from vipetsc.lattice import modes
from vipetsc.spectra import ModalParts
from vipetsc.studies.analysis import analyse

# The indices of the bands among the parts of the four-band lattice's spectrum; the other parts are gaps.
BANDS = [0, 2, 4, 6]


@pytest.fixture(scope="module")
def builtin():
    """The built-in run by exact steps, and its modal energies and transfers."""
    run = run_of(Case.load(overrides=['time.engine="propagator"']))
    return run, analyse(run, ["bands/transfer"])


def losses(run, analysis):
    """The energy in J lost in each cluster of contacts, summed from the log of impacts."""
    cluster = analysis["bands/cluster_of_episode"].values - 1
    return np.bincount(cluster, run["impacts/loss"].values, len(analysis["bands/cluster"]))


def test_modal_energies_of_the_built_in_run(builtin):
    """Modal energies sum to the energy, change in contacts alone, and end with known shares."""
    run, analysis = builtin
    energy = analysis["bands/modal_energy"]
    time = analysis["bands/instant"].values
    work = run["energy/work"].values[-1]
    assert len(time) > 400
    assert energy.attrs["error"] < 1e-12
    assert energy.attrs["modes"] == "of the lattice"

    whole = (run["energy/kinetic"] + run["energy/spring"]).values[np.searchsorted(run["time"].values, time)]
    assert np.abs(energy.values.sum(axis=0) - whole).max() < 1e-12 * whole.max()
    assert analysis["bands/bin_energy"].values.sum(axis=0) == pytest.approx(energy.values.sum(axis=0), rel=1e-12)

    # Nothing changes between two clusters of contacts, nor after the last one.
    begin = analysis["bands/cluster_begin"].values
    end = analysis["bands/cluster_end"].values
    waits = 0
    for start, stop in zip(end, [*begin[1:], np.inf], strict=True):
        inside = energy.values[:, (time >= start) & (time <= stop)]
        assert np.ptp(inside, axis=1).max() < 1e-9 * work
        waits += inside.shape[1] > 1
    assert waits > 20

    shares = energy.values[BANDS, -1] / energy.values[:, -1].sum()
    assert shares == pytest.approx([0.0021, 0.5691, 0.2974, 0.1314], abs=6e-5)

    # Modes of the fixed ends lie in a gap.
    parts = ModalParts.of(Case.of(run).model().chain)
    at_ends = np.flatnonzero(~np.isin(parts.part, BANDS))
    assert parts.modes.frequency[at_ends] == pytest.approx([2034.825] * 2, abs=1e-3)


def test_transfers_close_the_ledger_of_every_cluster(builtin):
    """The transfers of a cluster of contacts sum to minus the loss of its impacts, which lie within the cluster."""
    run, analysis = builtin
    transfer = analysis["bands/transfer"]
    work = run["energy/work"].values[-1]
    assert len(transfer) < len(run["impacts/onset"])
    assert transfer.attrs["cluster_stride"] == 1

    assert np.abs(transfer.values.sum(axis=1) + losses(run, analysis)).max() < 1e-9 * work
    assert analysis["bands/drive_work"].values.sum() == pytest.approx(work, rel=1e-9)

    cluster = analysis["bands/cluster_of_episode"].values - 1
    assert np.all(analysis["bands/cluster_begin"].values[cluster] <= run["impacts/onset"].values)
    assert np.all(run["impacts/separation"].values <= analysis["bands/cluster_end"].values[cluster])


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_what_contacts_that_are_closed_at_first_and_last_dissipate_is_that_of_the_log(engine):
    """A contact that is closed when the run begins or ends has energy of its own, which is not dissipated."""
    cell = {"masses": [1e-3], "springs": [{"start": 1, "end": 1, "stiffness": 1.1e3, "next_cell": True}]}
    contacts = {"law": "bilinear", "stiffness": 4e4, "restitution": 0.5, "sites": [1, 2], "pair": [0, 1]}
    contacts |= {"side": "plus", "clearance": 0.0}
    initial = {"kind": "mode", "number": 1, "amplitude": 5e-4}
    table = {"lattice": {"cells": 2, "cell": cell}, "contacts": contacts, "initial": initial}
    run = run_of(Case.from_table(table | {"time": {"end": 3.6e-3, "engine": engine}}))
    contact = run["energy/contact"].values
    analysis = analyse(run, ["bands/transfer"])

    moved = MovedEnergies.of(run, analysis, parts=[0])

    # The contacts are closed at first, and at last.
    assert contact[0] > 0
    assert contact[-1] > 0
    lost = moved.energy[:, -1].sum()
    assert lost == pytest.approx(run["energy/dissipated"].values[-1], rel=1e-9)
    assert -analysis["bands/transfer"].values.sum() == pytest.approx(lost + contact[-1] - contact[0], rel=1e-9)


def test_work_of_the_drive_is_no_transfer():
    """The work that the drive does during a cluster of contacts is not part of the cluster's transfers.

    The burst still lasts when waves reach the sites.
    """
    run = run_of(small_case(time={"engine": "propagator", "end": 0.08}))
    model = Case.of(run).model()
    analysis = analyse(run, ["bands/transfer"])
    time = run["time"].values
    work = run["energy/work"].values
    begin = analysis["bands/cluster_begin"].values
    end = analysis["bands/cluster_end"].values

    # Some clusters lie within the burst, and the drive does noticeable work in them.
    done = np.interp(end, time, work) - np.interp(begin, time, work)
    driven = (begin < model.drive.duration) & (end - begin < 2e-3)
    assert np.count_nonzero(driven & (np.abs(done) > 1e-3 * work[-1])) > 2

    transfer = analysis["bands/transfer"].values
    missing = np.abs(transfer.sum(axis=1) + losses(run, analysis))
    assert missing[driven].max() < 1e-8 * np.abs(work).max()

    total = run["energy/kinetic"].values[-1] + run["energy/spring"].values[-1]
    assert transfer.sum() + analysis["bands/drive_work"].values.sum() == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_run_in_memory_ends_with_the_state_of_its_last_sample(engine):
    run = run_of(small_case(time={"engine": engine, "end": 0.03}))
    for name in ("displacement", "velocity"):
        assert np.array_equal(run[f"end/{name}"].values, run[name].values[-1])

    # The share at the end needs only the state at the end, not the recorded displacements.
    both = analyse(run, ["upper_share_at_end"])["upper_share_at_end"].item()
    without = analyse(run.drop_vars("displacement"), ["upper_share_at_end"])["upper_share_at_end"].item()
    assert both == without > 0

    neither = analyse(run.drop_vars(["displacement", "end/displacement"]), ["upper_share_at_end"])
    assert "upper_share_at_end" not in neither
    assert "displacement was not recorded" in neither.attrs["left_out"]

    energy = run["energy/kinetic"].values + run["energy/spring"].values
    parts = ModalParts.of(Case.of(run).model().chain)
    every = parts.energies(run["displacement"], run["velocity"], range(len(energy)))
    assert np.abs(every.sum(axis=(0, 1)) - energy).max() < 1e-12 * energy.max()


def test_a_long_lattice_is_measured_on_a_ring(monkeypatch):
    """A lattice with more than MOST_DOFS degrees of freedom is measured by modes of a ring with one cell more."""
    run = run_of(small_case(lattice={"cells": 60}, time={"engine": "propagator", "end": 0.08}))
    exact = analyse(run, ["bands/transfer"])

    # The modes of this lattice are kept from the analysis before, and must not be kept for the next test.
    modes._modes.cache_clear()
    monkeypatch.setattr(modes, "MOST_DOFS", 100)
    ring = analyse(run, ["bands/transfer"])
    modes._modes.cache_clear()

    assert ring["bands/modal_energy"].attrs["modes"] == "of a ring of 61 cells"
    assert ring["bands/modal_energy"].attrs["error"] < 1e-12

    largest = exact["bands/modal_energy"].values.max()
    # The drive acts at an end, which the ring does not have: while it acts, waves are assigned to other bands.
    late = exact["bands/instant"].values > 0.06
    difference = ring["bands/modal_energy"].values - exact["bands/modal_energy"].values
    assert np.abs(difference[:, late]).max() < 0.02 * largest
