"""Pages of inter-band transfer from synthetic files: curves over branches, dispersions of members, warnings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.hertz_branch import write_branch
from vipetsc.case import Case, Sweep
from vipetsc.figures import transfer, wavenumber_bins
from vipetsc.figures.registry import FIGURES
from vipetsc.figures.style import rc_style
from vipetsc.figures.sweep_members import AmplitudeSeries, DrivenWave, Files, MemberRun, Sweeps
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import open_ensemble
from vipetsc.studies import backbone
from vipetsc.studies.backbone import Initiation, relate_folders

AMPLITUDES = np.geomspace(1.0, 1000.0, 8)
RESTITUTIONS = [0.3, 0.9]
ONSET = 2.0  # N
SWEEP = {
    "lattice": {"cells": 20},
    "contacts": {"sites": [9], "clearance": 1e-3},
    "sweep": {"contacts": {"restitution": RESTITUTIONS}, "drive": {"amplitude": AMPLITUDES.tolist()}},
}


@pytest.fixture(autouse=True)
def style():
    with rc_style():
        yield


def transfer_of(restitution: float) -> np.ndarray:
    """Return a transfer (amplitude,) that is proportional to the restitution and falls as 1/A^2 from the onset on."""
    # Curves of different restitutions have one exponent and differ in their height.
    falling = restitution * (ONSET / AMPLITUDES) ** 2
    return np.where(AMPLITUDES < ONSET, 1e-8, falling)


def write_sweep(folder: Path) -> None:
    """Write the ensemble of a sweep over two restitutions and eight amplitudes into ``folder``."""
    dims = ("restitution", "amplitude")
    number = np.arange(len(RESTITUTIONS) * len(AMPLITUDES)).reshape(len(RESTITUTIONS), -1)
    episodes = np.tile(np.where(AMPLITUDES < ONSET, 0.0, 4.0), (len(RESTITUTIONS), 1))

    data = {
        "status": (dims, np.zeros_like(number, np.int8)),
        "ibtet": (dims, np.stack([transfer_of(restitution) for restitution in RESTITUTIONS])),
        "work": (dims, np.tile(AMPLITUDES**2, (len(RESTITUTIONS), 1))),
        "contact_episodes": (dims, episodes),
    }
    coords = {
        "restitution": ("restitution", RESTITUTIONS, {"long_name": "contacts.restitution", "units": "1"}),
        "amplitude": ("amplitude", AMPLITUDES, {"long_name": "drive.amplitude", "units": "N"}),
    }

    case = Sweep.from_table(SWEEP).to_toml()
    write_netcdf(folder / "ensemble.h5", xr.Dataset(data, coords, {"case": case}))


def test_curves_of_two_values_of_a_key_are_both_laid_over_the_branch(tmp_path, monkeypatch):
    """Curves that differ in a key alone have a page each, named by the key and its value, with the branch."""
    sweep = tmp_path / "sweep"
    sweep.mkdir()
    write_sweep(sweep)
    branch = tmp_path / "branch"
    branch.mkdir()
    write_branch(branch, largest=1e7)
    initiation = Initiation(amplitude=ONSET, energy=ONSET**2, onset=ONSET)
    # The program takes the onset from a run; it is prescribed here.
    monkeypatch.setattr(backbone, "initiation_of", lambda folder, case: initiation)
    assert relate_folders([sweep, branch]) == [sweep / "backbone.h5"]

    with Files() as files:
        sweeps = Sweeps([open_ensemble(sweep)], files)
        pages = {drawing.stem: drawing.draw() for drawing in FIGURES["ibtet_backbone"].function(sweeps)}
    assert len(pages) == len(RESTITUTIONS)
    for (stem, figure), restitution in zip(pages.items(), RESTITUTIONS, strict=True):
        assert stem.endswith(f"contact-restitution-{restitution}")
        assert f"contact restitution {restitution}" in figure._suptitle.get_text()
        (axes,) = figure.axes
        (lattice,) = [line for line in axes.lines if line.get_label() == "lattice"]
        np.testing.assert_allclose(lattice.get_ydata(), transfer_of(restitution), rtol=1e-12)


def test_amplitudes_of_a_moved_wall_are_in_metres():
    """Headings of panels, and energies over the square of the amplitude, have the unit of what drives the lattice."""
    drive = {"cycles": 8, "band": 2, "at": "max-group-velocity", "end": "left"}
    numbers = {"snapshot": [0.0, 0.1], "kinetic": [1.0, 2.0], "reconstructed": [1.0, 2.0], "error": [1e-3, 1e-3]}
    numbers["cross_share"] = [0.1, 0.2]
    analysis = xr.Dataset({f"partition/{name}": ("snapshot", values) for name, values in numbers.items()})
    analysis["partition/energy"] = (("bin", "snapshot"), [[0.5, 1.0], [0.5, 1.0]])
    runs = []
    for amplitude in (1e-3, 2e-3, 4e-3):
        table = {"lattice": {"cells": 20}, "contacts": {"sites": [9]}, "drive": drive | {"amplitude": amplitude}}
        case = Case.from_table(table)
        runs.append(MemberRun(Path(), case, case.model(), xr.Dataset(), analysis))
    series = AmplitudeSeries(suffix="", title="", runs=tuple(runs), wave=DrivenWave(0, np.nan, np.nan))

    figure = wavenumber_bins.reconstruction.__wrapped__(series)

    assert [axes.get_title("left") for axes in figure.axes[:3]] == [
        "(a.i) Low amplitude, 0.001 m",
        "(b.i) Medium amplitude, 0.002 m",
        "(c.i) High amplitude, 0.004 m",
    ]
    assert figure.axes[0].get_ylabel() == "Kinetic energy / A² (J/m²)"


@pytest.mark.parametrize(
    ("peaks", "limits"),
    [
        ([2.0, 1e-3], (1e-8, 2e4)),
        ([1e-3, 2.0], (1e-8, 2e4)),
        ([2.0, 0.0], (2e-5, 2e4)),
        ([2.0, 1e-30], (2e-10, 2e4)),
        ([0.0, 0.0], (1e-5, 1e4)),
    ],
)
def test_spectra_of_two_cells_have_room_on_their_axis(peaks, limits):
    """The common axis ends above the larger peak and begins below the smaller one, unless that is a rounding error."""
    assert transfer._spectra_limits(peaks) == pytest.approx(limits)
