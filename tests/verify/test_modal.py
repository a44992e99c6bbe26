"""Modal energies of simulated runs: they are its energy, change at contacts alone, and close their ledger."""

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc import Case, simulate
from vipetsc.io.store import RunMemory
from vipetsc.lattice import modes
from vipetsc.spectra import ModalParts, upper_share
from vipetsc.studies.analysis import analyse

BANDS = [0, 2, 4, 6]  # parts of the four-band lattice; the others are gaps


def run_of(case):
    memory = RunMemory(MPI.COMM_SELF)
    assert simulate(case, memory, MPI.COMM_SELF).complete
    return memory.dataset


@pytest.fixture(scope="module")
def builtin():
    run = run_of(Case.load(overrides=['time.engine="propagator"']))
    return run, analyse(run, ("modal", "transfers"))


def losses(run, analysis):
    """Energy lost in every cluster, by the log of impacts."""
    cluster = analysis["bands/cluster_of_episode"].values - 1
    return np.bincount(cluster, run["impacts/loss"].values, len(analysis["bands/cluster"]))


@pytest.mark.slow
def test_built_in_run(builtin):
    run, analysis = builtin
    energy = analysis["bands/modal_energy"]
    time = analysis["bands/instant"].values
    work = run["energy/work"].values[-1]
    expected = (run["energy/kinetic"] + run["energy/spring"]).values[np.searchsorted(run["time"].values, time)]

    assert len(time) > 400
    assert np.abs(energy.values.sum(axis=0) - expected).max() < 1e-12 * expected.max()
    assert analysis["bands/bin_energy"].values.sum(axis=0) == pytest.approx(energy.values.sum(axis=0), rel=1e-12)
    assert energy.attrs["error"] < 1e-12
    assert energy.attrs["modes"] == "of the lattice"

    # Between two clusters nothing changes; the longest wait is that after the last.
    begin, end = (analysis[f"bands/cluster_{name}"].values for name in ("begin", "end"))
    waits = 0
    for start, stop in zip(end, [*begin[1:], np.inf], strict=True):
        inside = energy.values[:, (time >= start) & (time <= stop)]
        assert np.ptp(inside, axis=1).max() < 1e-9 * work
        waits += inside.shape[1] > 1

    assert waits > 20

    shares = energy.values[BANDS, -1] / energy.values[:, -1].sum()
    assert shares == pytest.approx([0.0021, 0.5691, 0.2974, 0.1314], abs=6e-5)

    parts = ModalParts.of(Case.of(run).model().chain)
    at_ends = np.flatnonzero(~np.isin(parts.part, BANDS))
    assert parts.modes.frequency[at_ends] == pytest.approx([2034.825] * 2, abs=1e-3)

    # Upper bands over the work; at .25 s, in the midst of the first contacts, one sample changes it by a tenth.
    model = Case.of(run).model()
    for when, share in ((0.3, 0.1113), (0.4, 0.2351), (0.5, 0.3365), (0.6, 0.3385)):
        at = int(np.searchsorted(run["time"].values, when - 1e-9))
        fields = (run[name].values[at] for name in ("displacement", "velocity"))
        assert upper_share(model.chain, model.drive, *fields, work) == pytest.approx(share, abs=1e-4)

    assert analysis["upper_share_at_end"].item() == pytest.approx(0.3385, abs=6e-5)


def test_transfers_close_the_ledger_of_every_cluster(builtin):
    run, analysis = builtin
    transfer = analysis["bands/transfer"].values
    work = run["energy/work"].values[-1]
    assert len(transfer) < len(run["impacts/onset"])
    assert analysis["bands/transfer"].attrs["cluster_stride"] == 1
    assert np.abs(transfer.sum(axis=1) + losses(run, analysis)).max() < 1e-9 * work
    assert analysis["bands/drive_work"].values.sum() == pytest.approx(work, rel=1e-9)

    for k, cluster in enumerate(analysis["bands/cluster_of_episode"].values):
        begin, end = (analysis[f"bands/cluster_{name}"].values[cluster - 1] for name in ("begin", "end"))
        assert begin <= run["impacts/onset"].values[k]
        assert run["impacts/separation"].values[k] <= end


def test_work_of_the_drive_is_no_transfer():
    """Sites that the burst's front meets while it is still on, too far from the driven cell to tell it in time."""
    run = run_of(small_case(time={"engine": "propagator", "end": 0.08}))
    model = Case.of(run).model()
    analysis = analyse(run, ("modal", "transfers"))
    time = run["time"].values
    work = run["energy/work"].values
    begin, end = (analysis[f"bands/cluster_{name}"].values for name in ("begin", "end"))
    done = np.interp(end, time, work) - np.interp(begin, time, work)
    checked = (begin < model.drive.duration) & (end - begin < 2e-3)

    assert np.count_nonzero(checked & (np.abs(done) > 1e-3 * work[-1])) > 2

    transfer = analysis["bands/transfer"].values
    missing = np.abs(transfer.sum(axis=1) + losses(run, analysis))
    assert missing[checked].max() < 1e-8 * np.abs(work).max()

    total = run["energy/kinetic"].values[-1] + run["energy/spring"].values[-1]
    assert transfer.sum() + analysis["bands/drive_work"].values.sum() == pytest.approx(total, rel=1e-12)


def test_without_contacts_all_is_work_of_the_drive():
    run = run_of(small_case(contacts={"sites": 0}, time={"engine": "propagator", "end": 0.08}))
    model = Case.of(run).model()
    analysis = analyse(run, ("modal", "transfers"))
    parts = ModalParts.of(model.chain)
    rest = np.zeros(len(parts.part), complex)
    span = np.array([0.0, model.drive.duration])
    expected = parts.driven_change(rest, model.drives, span)

    assert analysis["bands/drive_work"].values == pytest.approx(expected, abs=1e-9 * expected.sum())
    assert analysis["bands/transfer"].shape == (0, 8)


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_run_in_memory_ends_with_the_state_of_its_last_sample(engine):
    run = run_of(small_case(time={"engine": engine, "end": 0.03}))
    for name in ("displacement", "velocity"):
        assert np.array_equal(run[f"end/{name}"].values, run[name].values[-1])

    both, one = (analyse(data, ("modal",)) for data in (run, run.drop_vars("displacement")))
    assert both["upper_share_at_end"].item() == one["upper_share_at_end"].item() > 0

    neither = analyse(run.drop_vars(["displacement", "end/displacement"]), ("modal",))
    assert "upper_share_at_end" not in neither
    assert "displacement was not recorded" in neither.attrs["left_out"]

    energy = run["energy/kinetic"].values + run["energy/spring"].values
    every = ModalParts.of(Case.of(run).model().chain).energies(run["displacement"], run["velocity"], range(len(energy)))
    assert np.abs(every.sum(axis=(0, 1)) - energy).max() < 1e-12 * energy.max()


def test_a_long_lattice_says_what_its_ends_make_of_it(monkeypatch):
    run = run_of(small_case(lattice={"cells": 60}, time={"engine": "propagator", "end": 0.08}))
    exact = analyse(run, ("modal", "transfers"))
    modes._modes.cache_clear()
    monkeypatch.setattr(modes, "MOST_DOFS", 100)
    ring = analyse(run, ("modal", "transfers"))
    modes._modes.cache_clear()

    assert ring["bands/modal_energy"].attrs["modes"] == "of a ring of 61 cells"
    assert ring["bands/modal_energy"].attrs["error"] < 1e-12

    largest = exact["bands/modal_energy"].values.max()
    # The drive stands at an end, whose waves the ring takes for those of other bands as long as it acts.
    late = exact["bands/instant"].values > 0.06
    difference = ring["bands/modal_energy"].values - exact["bands/modal_energy"].values

    assert np.abs(difference[:, late]).max() < 0.02 * largest
