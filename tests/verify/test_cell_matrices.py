"""Cells from matrices: a beam of finite elements against Bloch's theorem and DOP853 on its assembled matrices."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import NnmCase
from vipetsc.case.section import CaseError
from vipetsc.lattice import bloch

ELEMENTS = 20
LENGTH = 0.4  # m, of a cell
EI = 2.0  # N m^2
DENSITY = 0.3  # kg/m
FOUNDATION = 40.0  # N/m at each node, with a dashpot of DASHPOT times that
DASHPOT = 1e-5  # s
CLEARANCE = 1e-5  # m


def beam():
    """M, K and C of a cell with both its ends: 21 nodes with deflection and rotation, 42 rows, masses lumped."""
    h = LENGTH / ELEMENTS
    size = 2 * (ELEMENTS + 1)
    mass, stiffness = np.zeros((2, size, size))
    shear = np.array([12, 6 * h, -12, 6 * h])
    left = [6 * h, 4 * h * h, -6 * h, 2 * h * h]
    right = [6 * h, 2 * h * h, -6 * h, 4 * h * h]
    bending = np.array([shear, left, -shear, right])
    for first in range(0, size - 2, 2):
        stiffness[first : first + 4, first : first + 4] += EI / h**3 * bending
        mass[range(first, first + 4), range(first, first + 4)] += DENSITY * h / 2 * np.array([1, h * h / 2] * 2)
    for node in range(0, size - 2, 2):
        stiffness[node, node] += FOUNDATION
    return mass, stiffness, DASHPOT * stiffness


BOUNDARY = [[1, 2], [41, 42]]


def wave_finite_elements(matrix, kappa):
    """The matrix at a wavenumber: the right end's rows and columns are those of the left end times a phase."""
    inner = len(matrix) - 2
    turn = np.vstack([np.eye(inner), np.exp(1j * kappa) * np.eye(2, inner)])
    return turn.conj().T @ matrix @ turn


def saved(folder, form, **changes):
    """The keys ``matrices`` and ``boundary`` of the beam's cell, in files of a ``form``."""
    matrices = dict(zip("MKC", beam(), strict=True)) | changes
    if form == "npz":
        np.savez(folder / "cell.npz", **matrices)
        return {"matrices": str(folder / "cell.npz"), "boundary": BOUNDARY}
    for name, matrix in matrices.items():
        scipy.io.mmwrite(folder / f"{name}.mtx", scipy.sparse.coo_matrix(matrix), precision=17)
    return {"matrices": [str(folder / f"{name}.mtx") for name in "MKC"], "boundary": BOUNDARY}


def table(cell, **sections):
    """A lattice of three cells of the beam, whose second node has a stop; a force acts on the middle of the first."""
    return {
        "lattice": {"cells": 3, "cell": cell | {"contact": [1, 21]}},
        "contacts": {"law": "bilinear", "stiffness": 4e3, "sites": [2], "pair": [0, 21], "clearance": CLEARANCE},
        "drive": {"amplitude": 2.0, "cycles": 3, "frequency": 2500.0, "cell": 1, "mass": 21},
        "time": {"end": 0.01, "rtol": 1e-11},
    } | sections


@pytest.mark.parametrize("form", ["npz", "mtx"])
def test_bands_are_those_of_wave_finite_elements(form, tmp_path):
    """Compares all 40 frequencies at 20 wavenumbers, and damping, with the Bloch matrices of the whole cell."""
    cell = Case.from_table(table(saved(tmp_path, form))).lattice.unit_cell()
    mass, stiffness, damping = beam()
    assert cell.dofs == 40 and min(spring.stiffness for spring in cell.springs) < 0
    for kappa in np.linspace(0, np.pi, 20):
        k, m, c = (wave_finite_elements(matrix, kappa) for matrix in (stiffness, mass, damping))
        squared = scipy.linalg.eigh(k, m, eigvals_only=True)
        np.testing.assert_allclose(bloch(cell, kappa).frequency ** 2, squared, rtol=1e-8, atol=1e-11 * squared.max())
        np.testing.assert_allclose(cell.damping_matrix(kappa), c, atol=1e-9 * np.abs(c).max())


def test_a_resolved_case_needs_no_files(tmp_path):
    """A name is one in the folder of the case file; a resolved case has masses and springs, and other verbs take it."""
    saved(tmp_path, "npz")
    path = tmp_path / "case.toml"
    path.write_text(
        """
        [lattice]
        cells = 3
        cell = { matrices = "cell.npz", boundary = [[1, 2], [41, 42]], contact = [1, 21] }
        [contacts]
        law = "bilinear"
        stiffness = 4e3
        sites = [2]
        clearance = 1e-5
        [drive]
        amplitude = 2.0
        frequency = 2500.0
        [nnm]
        system = "condensed"
        start_frequency = [25000.0]
        energy = [0.0, 1e-9]
        [nfrc]
        source = "force"
        range = [2000.0, 3000.0]
        fixed = [1.0]
        """
    )
    texts = [kind.load(path).to_toml() for kind in (Case, NnmCase, NfrcCase)]
    (tmp_path / "cell.npz").unlink()
    assert [
        kind.from_toml(text).to_toml() for kind, text in zip((Case, NnmCase, NfrcCase), texts, strict=True)
    ] == texts
    with pytest.raises(CaseError, match=r"matrices.*no such file"):
        Case.load(path)


def _full_mass():
    """A consistent mass matrix: the one that is lumped, with a part of each node's mass between neighbours."""
    mass = beam()[0]
    return mass + 0.1 * mass[0, 0] * (np.eye(len(mass), k=2) + np.eye(len(mass), k=-2))


M, K, C = beam()


@pytest.mark.parametrize(
    "matrices, cell, sections, word",
    [
        ({"M": _full_mass()}, {}, {}, "lumped"),
        ({"M": M + 1e-2 * M[0, 0] * (np.eye(42, k=40) + np.eye(42, k=-40))}, {}, {}, "1 and 1 of the next cell"),
        ({"M": M - 2 * np.diag(np.diag(M) * (np.arange(42) == 5))}, {}, {}, "freedom 6"),
        ({"M": M * (np.arange(42) != 7)}, {}, {}, "freedom 8"),
        ({"M": K, "K": M}, {}, {}, "order"),
        ({"K": K + np.eye(42, k=3)}, {}, {}, "symmetric"),
        ({"K": -K}, {}, {}, "K is not positive semidefinite"),
        ({"C": -C}, {}, {}, "C is not positive semidefinite"),
        ({"C": np.eye(42) + 0.5 * (np.eye(42, k=9) + np.eye(42, k=-9))}, {}, {}, "C couples"),
        ({"K": K[:40, :40]}, {}, {}, "one size"),
        ({"K": K * np.nan}, {}, {}, "not numbers"),
        ({"K_next": K}, {}, {}, "boundary"),
        ({"stiffness": K}, {}, {}, "it needs M and K"),
        ({}, {"boundary": [[1, 2], [41, 43]]}, {}, "lattice.cell.boundary = "),
        ({}, {"boundary": [[1, 2], [41]]}, {}, "boundary"),
        ({}, {"boundary": None}, {}, "connect"),
        ({}, {"masses": [1.0]}, {}, "not both"),
        ({}, {"matrices": "none.npz"}, {}, "no such file"),
        ({}, {"matrices": __file__}, {}, "matrices"),
        ({}, {}, {"lattice": {"ends": "free"}}, "lattice.ends"),
        ({}, {}, {"drive": {"end": "left"}}, "drive.end"),
    ],
)
def test_other_matrices_are_refused(matrices, cell, sections, word, tmp_path):
    """Names what is wrong."""
    given = table(
        {key: value for key, value in (saved(tmp_path, "npz", **matrices) | cell).items() if value is not None}
    )
    given["lattice"] |= sections.get("lattice", {})
    given["drive"] |= sections.get("drive", {})
    with pytest.raises(CaseError, match=word):
        Case.from_table(given)
