"""What strips do by theory: rays of a resonant drive, springs seen from either end, modes, responses and fits."""

from mpi4py import MPI

import numpy as np
import pytest

import vipetsc
from tests.conftest import simulated
from vipetsc.case import Case
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import NnmCase
from vipetsc.io.branch_kinds import kind_names
from vipetsc.modes.branches.follow import follow_all
from vipetsc.studies.identification import run_identification

M, K = 0.01, 1e4
RATE = np.sqrt(K / M)  # rad/s


def strip(rows, cells, ends="fixed", edges="fixed", **keys):
    return {"cells": cells, "ends": ends, "strip": {"rows": rows, "mass": M, "stiffness": K, "edges": edges} | keys}


def energy_at(run, places):
    """Mean kinetic energy in J of the masses at places (i, j), from 0, over the last quarter of a run."""
    late = run["velocity"].values[-len(run["time"]) // 4 :]
    return float(np.mean([0.5 * M * late[:, i, j] ** 2 for i, j in places]))


def test_a_resonant_point_drive_sends_rays_along_the_diagonals():
    """At omega^2 = 4 k/m all waves with |k_1| + |k_2| = pi go along diagonals; long waves go all round."""
    middle = 20
    reach = 9
    diagonal = round(reach / np.sqrt(2))
    ratio = {}
    for frequency in (0.7, 2.0):
        table = {
            "lattice": strip(41, 41, ends="free", edges="free"),
            "drive": {
                "amplitude": 1.0,
                "waveform": "harmonic",
                "frequency": frequency * RATE,
                "place": [middle + 1, middle + 1],
            },
            "contacts": {"sites": []},
            "time": {"end": 0.034, "engine": "ts", "rtol": 1e-6},
        }
        run, _ = simulated(Case.from_table(table))
        signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
        along = [(middle + reach * a, middle) for a in (-1, 1)] + [(middle, middle + reach * a) for a in (-1, 1)]
        across = [(middle + diagonal * a, middle + diagonal * b) for a, b in signs]
        ratio[frequency] = energy_at(run, across) / energy_at(run, along)
    assert ratio[2.0] > 30
    assert 0.5 < ratio[0.7] < 2


@pytest.mark.parametrize("edges", ["free", "fixed", "periodic"])
def test_a_curved_spring_pulls_alike_seen_from_either_end(edges):
    """Seen from its other end the elongation has the other sign, and so has the quadratic coefficient."""
    springs = [([1, 0], K, 2e8), ([0, 1], K, 3e8), ([-1, 1], K / 3, 1e8)]
    moved = []
    for sign in (1, -1):
        turned = [
            {"start": 1, "end": 1, "offset": [sign * i, sign * j], "stiffness": k, "quadratic": sign * q}
            for (i, j), k, q in springs
        ]
        lattice = {"cells": 4, "ends": "fixed", "strip": {"rows": 3, "kind": "cell", "masses": [M], "edges": edges}}
        lattice["strip"]["springs"] = turned
        table = {
            "lattice": lattice,
            "contacts": {"sites": []},
            "drive": {"amplitude": 2.0, "frequency": 800.0, "place": [2, 1]},
            "time": {"end": 0.02, "engine": "ts"},
        }
        moved.append(simulated(Case.from_table(table))[0]["displacement"].values)
        lattice["strip"]["springs"] = [spring | {"quadratic": 0.0} for spring in turned]
        linear = simulated(Case.from_table(table))[0]["displacement"].values
    size = np.abs(linear).max()
    assert np.abs(moved[0] - linear).max() > 0.01 * size
    np.testing.assert_allclose(moved[0], moved[1], rtol=0, atol=1e-8 * size)


CONTACTS = {"places": [[3, 2]], "law": "bilinear", "stiffness": 5 * K, "clearance": 1e-3}


def test_modes_responses_and_fits_of_a_strip(tmp_path):
    """The lowest mode and its grazing energy, the response to a force, and a clearance that is found again."""
    cells = 4
    rows = 3
    waves = [np.pi * np.arange(1, n + 1) / (n + 1) for n in (cells, rows)]
    squares = 4 * RATE**2 * np.add.outer(*(np.sin(wave / 2) ** 2 for wave in waves))
    shape = np.outer(*(np.sin(wave) for wave in waves))
    table = {"lattice": strip(rows, cells), "contacts": CONTACTS}

    # The mode grazes where the mass at (3, 2) reaches its stop.
    graze = 0.5 * M * squares[0, 0] * np.sum((1e-3 * shape / shape[2, 1]) ** 2)
    nnm = {"system": "chain", "modes": [1], "energy": [0.0, 1.05 * graze]}
    for name in ("nnm", "nfrc"):
        (tmp_path / name).mkdir()
    follow_all(NnmCase.from_table(table | {"nnm": nnm}), tmp_path / "nnm", MPI.COMM_SELF)
    with vipetsc.open(tmp_path / "nnm" / "branch-mode-1.h5") as branch:
        rest = branch["period"].values[branch["contacts"].values == 0]
        np.testing.assert_allclose(rest, 2 * np.pi / np.sqrt(squares[0, 0]), rtol=1e-9)
        at = kind_names(branch) == "grazing"
        np.testing.assert_allclose(branch["energy"].values[at], [graze], rtol=1e-6)

    # Below its clearance the response is the sum over the modes, with dashpots of 20/s to the ground.
    force, frequency = 0.05, 700.0
    drive = {"amplitude": force, "waveform": "harmonic", "frequency": frequency, "place": [2, 2]}
    nfrc = {
        "source": "force",
        "over": "amplitude",
        "range": [0.5 * force, force],
        "fixed": [frequency],
        "harmonics": 5,
        "points": 20,
    }
    table["lattice"]["damping"] = {"mass": 20.0}
    case = NfrcCase.from_table(
        table | {"drive": drive, "nfrc": nfrc, "output": {"points": [{"name": "far", "place": [4, 1]}]}}
    )
    follow_all(case, tmp_path / "nfrc", MPI.COMM_SELF)
    modes = [np.sin(np.outer(wave, np.arange(1, len(wave) + 1))) * np.sqrt(2 / (len(wave) + 1)) for wave in waves]
    moved = np.einsum("a,b,ab,a,b", modes[0][:, 1], modes[1][:, 1], 1 / (squares - frequency**2 + 20j * frequency),
                      modes[0][:, 3], modes[1][:, 0])  # fmt: skip
    (path,) = (tmp_path / "nfrc").glob("branch-*.h5")
    with vipetsc.open(path) as branch:
        assert branch["amplitude"][-1] == force
        np.testing.assert_allclose(branch["peak_displacement"][-1, 0], force / M * abs(moved), rtol=1e-6)

    # A record of a run with contacts leads back to its clearance.
    drive["amplitude"] = 60.0
    points = [{"name": "near", "place": [3, 2]}]
    run, _ = simulated(Case.from_table(table | {"drive": drive, "time": {"end": 0.06}, "output": {"points": points}}))
    assert run.sizes["episode"] > 3
    record = np.column_stack([run["time"], run["points/velocity"][:, 0]])
    np.savetxt(tmp_path / "near.csv", record, delimiter=",", header="time,near", comments="")
    sensor = {"quantity": "velocity", "column": "near", "place": [3, 2]}
    records = [{"file": str(tmp_path / "near.csv"), "time": "time", "sensors": [sensor]}]
    unknowns = [{"quantity": "clearance", "bounds": [5e-4, 2e-3]}]
    guess = table | {"contacts": CONTACTS | {"clearance": 1.2e-3}, "drive": drive}
    plan = IdentifyCase.from_table(guess | {"identify": {"records": records, "unknowns": unknowns}})
    fit = run_identification(plan, tmp_path / "fit", MPI.COMM_SELF)
    np.testing.assert_allclose(fit["value"], [1e-3], rtol=1e-6)
