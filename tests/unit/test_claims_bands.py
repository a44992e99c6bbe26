"""Claim C13, that energies of the bands add up, from fields with prescribed spectra; claim C10 on the design."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.unit.claim_files import measure
from tests.unit.test_claims_transfer import put_amplitudes
from vipetsc.case import Case
from vipetsc.lattice import pass_bands
from vipetsc.paper.claims.criteria import FAILS, HOLDS, IN_PART, LAWS
from vipetsc.paper.paper_figures import READINGS
from vipetsc.spectra import Parts, dispersion, part_energies

OF_RECORD = "largest error of the mean over the record"
OF_PERIOD = "mean error over a period of the drive"
OUTSIDE = "largest fraction outside the paper's bands and gaps"
IN_SPECTRUM = "largest difference of a part's fraction from that in the space-time spectrum"
# Times of the samples in s: 4000 a second resolve frequencies up to 2000 Hz, and the top band ends at 580 Hz.
TIME = np.arange(1500) * 2.5e-4


def travelling_waves(case: Case, energies: Mapping[float, float]) -> np.ndarray:
    """Return the velocity (t, cell, dof) of waves, whose ``energies`` in J are given by their frequencies in rad/s."""
    masses = np.asarray(case.lattice.unit_cell().masses)
    cells = case.lattice.cells
    velocity = np.zeros((len(TIME), cells, len(masses)))
    for number, (frequency, energy) in enumerate(energies.items(), 1):
        phase = 2 * np.pi * 3 * number * np.arange(cells) / cells
        wave = np.sin(frequency * TIME[:, None] - phase)
        velocity += np.sqrt(4 * energy / masses.sum() / cells) * wave[:, :, None]
    return velocity


def in_two_bands(case: Case) -> np.ndarray:
    """Return the velocity of waves with 0.7 J in band 2 and 0.3 J in band 3."""
    return travelling_waves(case, {1000.0: 0.7, 2700.0: 0.3})


def partly_in_gap_2(case: Case) -> np.ndarray:
    """Return the velocity of waves with 0.9 J in band 2 and 0.1 J in the middle of the gap above it."""
    _, second, third, _ = pass_bands(case.lattice.unit_cell())
    return travelling_waves(case, {1000.0: 0.9, (second.high + third.low) / 2: 0.1})


def partly_in_gap_3(case: Case) -> np.ndarray:
    """Return the velocity of waves with 0.9 J in band 2 and 0.1 J in the middle of the gap between bands 3 and 4."""
    _, _, third, fourth = pass_bands(case.lattice.unit_cell())
    return travelling_waves(case, {1000.0: 0.9, (third.high + fourth.low) / 2: 0.1})


def noise(case: Case) -> np.ndarray:
    return np.random.default_rng(2).normal(size=(len(TIME), case.lattice.cells, 4))


def on_an_edge(case: Case) -> np.ndarray:
    """Return the velocity of a tone at the upper edge of band 2 that beats in all cells together."""
    edge = pass_bands(case.lattice.unit_cell())[1].high
    beat = np.cos(20 * TIME) * np.sin(edge * TIME)
    return beat[:, None, None] * np.ones((case.lattice.cells, 4))


# Errors that a split into parts may have: each function takes and returns energies (part, t).


def as_it_is(energy: np.ndarray) -> np.ndarray:
    return energy


def bands_2_and_3_swapped(energy: np.ndarray) -> np.ndarray:
    order = np.arange(len(energy))
    order[[2, 4]] = 4, 2
    return energy[order]


def eleven_per_mille_more(energy: np.ndarray) -> np.ndarray:
    return 1.011 * energy


def put_bands(
    root: Path,
    velocity: Callable[[Case], np.ndarray],
    change: Callable[[np.ndarray], np.ndarray],
    laws: Sequence[str] = LAWS,
) -> None:
    """Write the bands' energies of runs with the fields ``velocity(case)``, with an error ``change`` for ``laws``."""

    def content(case: Case) -> dict[str, Any]:
        cell = case.lattice.unit_cell()
        masses = np.asarray(cell.masses)
        parts = Parts.of(pass_bands(cell))
        v = velocity(case)
        spectrum = dispersion(v, masses, TIME[1]).folded()
        energy = part_energies(v, masses, TIME[1], parts.edges).total
        if case.contacts.law in laws:
            energy = change(energy)

        return {
            "bands/sample": TIME,
            "frequency": spectrum.frequency,
            "dispersion": spectrum.energy,
            "bands/edges": parts.edges,
            "bands/total": 0.5 * np.einsum("tcd,d->t", v**2, masses),
            "bands/energy": energy,
            "ibtet": 0.3,
            "bands/share": np.zeros(len(parts.names)),
        }

    put_amplitudes(root, content)


@pytest.mark.parametrize(
    ("velocity", "change", "expected", "missed"),
    [
        (in_two_bands, as_it_is, HOLDS, ""),
        (in_two_bands, bands_2_and_3_swapped, FAILS, IN_SPECTRUM),
        (on_an_edge, as_it_is, FAILS, OF_PERIOD),
        (noise, as_it_is, FAILS, OUTSIDE),
        (partly_in_gap_2, as_it_is, FAILS, OUTSIDE),
        (partly_in_gap_3, as_it_is, HOLDS, ""),
        (in_two_bands, eleven_per_mille_more, FAILS, OF_RECORD),
    ],
)
def test_bands_add_up_only_where_the_split_is_right(tmp_path, velocity, change, expected, missed):
    """Claim C13 holds for waves inside bands and an exact split, and fails with the quantity ``missed`` else.

    Waves that beat across an edge, noise outside the bands, and energies that overlap, lack a band, are exchanged or
    1.1 % too large fail; 0.3 % is within the bound of 1 %. The paper counts the gap between bands 3 and 4, and not the
    one between bands 2 and 3.
    """
    put_bands(tmp_path, velocity, change)
    found = measure("C13", tmp_path)
    assert found.verdict == expected, found
    assert missed in found.reason
    assert found.figure.endswith("calibrated-5-sites-30-cycles-24N")


def put_design(root, lam, eta, out_of_phase):
    """Write a search on a grid of 0.05, whose best cell lies at ``lam`` and 0.045 below ``eta``.

    ``out_of_phase`` (lambda, eta) is nonzero in the cells that may be the optimum.
    """
    folder = root / "design"
    folder.mkdir()
    grid = np.arange(2, 19) * 0.05
    distance = np.hypot(grid[:, None] - lam, grid[None, :] - eta + 0.045)
    best = {"optimum_lambda": lam, "optimum_eta": eta, "optimum_value": 1.0}
    with h5py.File(folder / "design.h5", "w") as file:
        file["reading"] = ["printed", "calibrated"]
        file["cost"] = ["deflection", "group_velocity", "weighted"]
        file["lambda"] = grid
        file["eta"] = grid
        file["weighted"] = np.stack([1 - distance] * 2)
        file["out_of_phase"] = np.stack([out_of_phase] * 2).astype(np.int8)
        for name, value in best.items():
            file[name] = np.full((2, 3), value if out_of_phase.any() else np.nan)
        file["paper_value"] = np.full((2, 3), 0.9)


@pytest.mark.parametrize(("lam", "eta", "expected"), [(0.1, 0.5, HOLDS), (0.1, 0.8, IN_PART), (0.6, 0.8, IN_PART)])
def test_the_design_is_that_of_a_coarse_grid(tmp_path, lam, eta, expected):
    """The optimum on a grid of 0.1 counts, although the fine grid has a better one 0.045 lower in eta."""
    put_design(tmp_path, lam, eta, np.ones((17, 17)))
    for reading in READINGS:
        claim = measure("C10", tmp_path, reading)
        assert claim.verdict == expected
        assert claim.value["eta at the optimum of a grid of 0.1"] == pytest.approx(eta)


@pytest.mark.parametrize("cells", ["none", "between the points of the coarse grid"])
def test_a_design_without_cells_out_of_phase_has_no_optimum(tmp_path, cells):
    """No number stands for an optimum on the coarse grid where none of its cells is out of phase."""
    out_of_phase = np.zeros((17, 17))
    if cells != "none":
        out_of_phase[1::2] = 1
    put_design(tmp_path, 0.1, 0.5, out_of_phase)

    claim = measure("C10", tmp_path)
    assert claim.verdict == FAILS
    assert claim.value["lambda at the optimum of a grid of 0.1"] is None
    assert claim.value["eta at the optimum of a grid of 0.1"] is None
