"""Members of a sweep are scaled where nothing touches, and simulated where something may."""

import os
import shutil

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets
from tests.faults.inject import Injector
from vipetsc.case import Case, Sweep
from vipetsc.case.sweep import SweepTable
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_ensemble, select
from vipetsc.parallel import StopRequest
from vipetsc.studies.ensemble import COMPLETE, SCALED
from vipetsc.studies.members import MemberStore, reached, read_wave
from vipetsc.studies.sweep import run_sweep

TABLE = {
    "name": "margin",
    "lattice": {"preset": "four-band", "cells": 24},
    "contacts": {"sites": [8, 13], "clearance": [2e-4, 3e-4]},
    "drive": {"cycles": 4, "cell": 3},
    "time": {"end": 0.08, "rtol": 1e-9},
}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Amplitudes at which the linear wave reaches .6, .85, 1.02, 1.1, 1.25 and 3 times the nearest clearance."""
    folder = tmp_path_factory.mktemp("members")
    case = Case.from_table(TABLE | {"drive": TABLE["drive"] | {"amplitude": 1.0}})
    MemberStore(folder / "wave", SweepTable.model_validate({}), MPI.COMM_SELF, StopRequest()).make_linear(case)
    one = reached(read_wave(folder / "wave", case), case).max()
    shares = np.array([0.6, 0.85, 1.02, 1.1, 1.25, 3.0])
    table = TABLE | {"sweep": {"drive": {"amplitude": (shares / one).tolist()}}}
    result = run_sweep(Sweep.from_table(table), folder / "sweep")
    assert result.complete
    return shares, open_ensemble(folder / "sweep"), folder / "sweep"


def test_a_member_is_simulated_unless_its_wave_stays_well_inside_the_clearance(sweep):
    shares, ensemble, _ = sweep
    assert ensemble["status"].values.tolist() == [SCALED if share < 0.9 else COMPLETE for share in shares]
    # The wave that reaches a clearance touches it: scaling such a member would lose its contacts.
    touching = shares > 1.05
    assert (ensemble["contact_episodes"].values[touching] > 0).all()
    assert (ensemble["contact_episodes"].values[shares < 1] == 0).all()
    assert (ensemble["dissipated_fraction"].values[touching] > 0).all()


def test_energies_of_scaled_members_go_with_the_square_of_the_amplitude(sweep):
    _, ensemble, folder = sweep
    amplitude = ensemble["amplitude"].values[:2]
    low, high = (folder / str(name) for name in ensemble["member"].values[:2])
    factor = (amplitude[1] / amplitude[0]) ** 2
    for file, names in {"run": ("energy/kinetic", "energy/work"), "analysis": ("bands/energy", "bands/total")}.items():
        with open_netcdf(low / f"{file}.h5", file) as small, open_netcdf(high / f"{file}.h5", file) as large:
            assert "velocity" not in small
            for name in names:
                np.testing.assert_allclose(large[name], factor * small[name], rtol=1e-13)
            assert Case.of(large).drive.amplitude == amplitude[1]
            if file == "run":
                assert large["sites/cell"].values.tolist() == TABLE["contacts"]["sites"]
                assert large["sites/clearance"].values.tolist() == TABLE["contacts"]["clearance"]
                assert large["energy/dissipated_by_site"].shape == (large.sizes["time"], 2)
                assert not large["energy/dissipated_by_site"].values.any()
            else:
                assert large["ibtet"].item() == small["ibtet"].item()
                assert large["bands/edges"].values.tolist() == small["bands/edges"].values.tolist()
    assert select(ensemble, amplitude=amplitude[0])["work"].item() > 0


def test_what_is_kept_does_not_change_what_is_measured(sweep, tmp_path):
    _, ensemble, _ = sweep
    amplitudes = ensemble["amplitude"].values[2:5].tolist()  # those that a coarse linear wave might take for quiet
    table = TABLE | {"sweep": {"drive": {"amplitude": amplitudes}}, "output": {"stride": 10, "every": 2}}
    assert run_sweep(Sweep.from_table(table), tmp_path / "thin").complete
    thin = open_ensemble(tmp_path / "thin")
    for name in ("status", "contact_episodes", "ibtet", "entropy/energy_weighted", "entropy/masked", "bands/share"):
        np.testing.assert_array_equal(thin[name].values, ensemble[name].values[2:5], name)


def test_files_that_were_cut_are_named_and_made_again(sweep, tmp_path):
    _, ensemble, folder = sweep
    out = shutil.copytree(folder, tmp_path / "out")
    before = {path.relative_to(out): datasets(path) for path in out.rglob("*.h5")}
    scaled, *touching = (out / str(name) for name in ensemble["member"].values[[0, 3, 4, 5]])
    (shared,) = out.glob("linear/*/analysis-*.h5")
    damaged = [scaled / "run.h5", shared, touching[0] / "summary.json", touching[1] / "analysis.h5",
               touching[2] / "run.h5", shared.with_name("wave.h5"), shared.with_name("run.h5")]  # fmt: skip
    for number, path in enumerate([*damaged, out / "ensemble.h5", out / "index.json"]):
        os.truncate(path, path.stat().st_size // 2 if number % 2 else 0)
    again = run_sweep(Sweep.load(out / "case.toml"), out)
    assert again.complete and again.made == 4
    # The wave is looked at first, and what was measured from its run goes with it.
    named = [path for path in damaged if path not in (shared, shared.with_name("run.h5"))]
    assert len(again.warnings) == len(named)
    for path in named:
        (warning,) = (text for text in again.warnings if str(path) in text)
        assert "cannot be" in warning and warning.endswith("made again")
    assert {path.relative_to(out) for path in out.rglob("*.h5")} == set(before)
    for path, found in before.items():
        assert_same_bits(found, datasets(out / path))
    # A linear run alone, with what was measured of it.
    for path in (shared, shared.with_name("run.h5")):
        os.truncate(path, 100)
    once_more = run_sweep(Sweep.load(out / "case.toml"), out)
    assert once_more.made == 0 and [str(shared.with_name("run.h5")) in text for text in once_more.warnings] == [True]
    # Where it cannot be made again the members stay as they are.
    os.truncate(shared.with_name("run.h5"), 100)
    injector = Injector()
    injector.arm("member", 1, "memory")
    assert run_sweep(Sweep.load(out / "case.toml"), out).complete
    injector.disarm()
