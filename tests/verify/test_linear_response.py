"""Linear frequency responses of nfrc against the dense solution of the equations of motion, and their pictures."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest

from tests.rigs import TWO_MASSES
from vipetsc.case.nfrc import NfrcCase
from vipetsc.cli.main import main
from vipetsc.io.read import open_results

POINTS = {"points": [{"name": "near", "cell": 1}, {"name": "far", "cell": 3}], "transmission": [["near", "far"]]}
OVER = {"source": "force", "over": "frequency", "range": [0.4, 2.6], "fixed": [0.2], "points": 45}
WALL = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "end": "left"}
FORCE = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "cell": 2, "mass": 1}


def table(**changes):
    """The rig of two masses, made three, without contacts, and with ``changes`` of its sections."""
    case = copy.deepcopy(TWO_MASSES)
    case["lattice"]["cells"] = 3
    del case["lattice"]["cell"]["contact"]
    return case | {"contacts": {"sites": []}, "output": POINTS, "nfrc": OVER} | changes


def curve_of(case: dict, folder):
    """The file of the only curve of a case, computed by the verb."""
    folder.mkdir(exist_ok=True)
    path = folder / "case.toml"
    path.write_text(NfrcCase.from_table(case).to_toml())
    assert main(["nfrc", str(path), "--out", str(folder / "out"), "--quiet"]) == 0
    (file,) = (folder / "out").glob("branch-*.h5")
    return open_results(file)


@pytest.mark.parametrize("damping", [0.06, 0.0])
@pytest.mark.parametrize("drive, ends", [(WALL, "fixed"), (FORCE, "fixed"), (FORCE, "free"), (FORCE, "periodic")])
def test_the_linear_response_is_the_dense_solution(drive, ends, damping, tmp_path):
    """Compares displacement, velocity, acceleration, phase and transmission of two masses on the whole grid."""
    case = table(drive=drive, nfrc=OVER | {"infinite": False})
    case["lattice"] |= {"ends": ends, "damping": {"mass": damping}}
    if not damping:
        del case["lattice"]["damping"]
    with curve_of(case, tmp_path) as curve:
        chain = NfrcCase.from_table(case).model().chain
        load = np.zeros(3)
        # The spring of the wall pulls with 1.5 N/m.
        load[0 if drive is WALL else 1] = 0.2 * (1.5 if drive is WALL else 1.0)
        omega = np.linspace(0.4, 2.6, 45)
        stiffness = chain.stiffness_matrix().toarray()
        loss = chain.damping_rows(0, 3).toarray()
        u = np.array([np.linalg.solve(stiffness + 1j * w * loss - w**2 * np.eye(3), load) for w in omega])[:, [0, 2]]

        np.testing.assert_allclose(curve["frequency"], omega)
        for power, quantity in enumerate(("displacement", "velocity", "acceleration")):
            size = np.abs(u) * omega[:, None] ** power
            np.testing.assert_allclose(curve[f"first_{quantity}"], size, rtol=1e-9)
            np.testing.assert_allclose(curve[f"peak_{quantity}"], size, rtol=1e-9)
        turned = np.exp(-1j * np.radians(curve["lag"].values))
        np.testing.assert_allclose(turned, u / np.abs(u), atol=1e-8)
        np.testing.assert_allclose(curve["transmission"][:, 0], np.abs(u[:, 1] / u[:, 0]), rtol=1e-9)
    assert (tmp_path / "out" / "figures" / f"outputs-{curve.attrs['name']}.png").exists()


@pytest.mark.parametrize("ends", ["free", "periodic"])
def test_balanced_forces_strain_a_free_lattice_and_do_not_move_it(ends, tmp_path):
    """Two opposite forces at a low frequency: displacements as at rest, which rounding over omega^2 would exceed."""
    force = {"cell": 2, "mass": 1, "amplitude": 0.1}
    drive = (
        FORCE
        | force
        | {"frequency": 1e-4, "more": [FORCE | {"cell": 14, "mass": 1, "amplitude": -0.1, "frequency": 1e-4}]}
    )
    case = table(drive=drive, nfrc=OVER | {"infinite": False, "range": [1e-9, 1e-6], "points": 3})
    case["lattice"] |= {"cells": 20, "ends": ends}
    case["output"] = {"points": [{"name": f"n{cell}", "cell": cell} for cell in range(1, 21)]}
    del case["lattice"]["damping"]
    inner = {"start": 1, "end": 2, "stiffness": 1e3, "damping": 1e-3}
    case["lattice"]["cell"] = {"masses": [1.0, 0.01], "springs": [*case["lattice"]["cell"]["springs"], inner]}
    stiffness = NfrcCase.from_table(case).model().chain.stiffness_matrix().toarray()
    load = np.zeros(40)
    load[[2, 26]] = 0.2, -0.2
    at_rest = np.linalg.lstsq(stiffness, load, rcond=1e-10)[0][::2]
    with curve_of(case, tmp_path) as curve:
        u = curve["location_harmonics"].values[:, :, 1]
    np.testing.assert_allclose(u - u[:, :1], np.tile(at_rest - at_rest[0], (3, 1)), rtol=1e-5, atol=1e-6)


def test_a_frequency_at_an_undamped_resonance_is_named(tmp_path):
    """Three masses between free ends have a mode at sqrt(3 k/m); the grid's other frequencies are not named."""
    case = table(drive=FORCE, nfrc=OVER | {"infinite": False, "range": [np.sqrt(4.5), 3.0], "points": 3})
    case["lattice"] |= {"ends": "free"}
    case["lattice"] |= {"damping": {"mass": 1e-3}}
    with curve_of(case, tmp_path / "damped") as curve:
        assert json.loads(curve.attrs["warnings"]) == []
    del case["lattice"]["damping"]
    with curve_of(case, tmp_path / "undamped") as curve:
        (warning,) = json.loads(curve.attrs["warnings"])
    assert "2.1213" in warning and "2.56" not in warning
