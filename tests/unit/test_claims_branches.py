"""Claims C15 to C17 on the reduced model and on the lattice's motion, from files with prescribed branches."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.unit.claim_files import measure
from vipetsc.paper.claims.criteria import FAILS, HOLDS, IN_PART, UNMEASURED
from vipetsc.spectra import power_law

# High-energy limit in Hz of the out-of-phase branch with the bilinear law, in the printed reading.
BILINEAR_LIMIT = 10252.6169369


def put_branch(
    root: Path,
    law: str,
    folds: int = 2,
    multiplier: float = 50.0,
    limit: float = 1.0,
    flat: float = 0.0,
    r2: float = 0.99,
) -> None:
    """Write an out-of-phase branch of the printed reading through four regions.

    ``folds`` energy folds lie in region II, with this largest ``multiplier``; ``limit`` is the ratio of the last
    frequency, or of its slope, to what the law demands, ``flat`` the slope d ln f/d ln E in region I, ``r2`` that of
    the fit in region III.
    """
    energy = 0.03 * np.concatenate([np.geomspace(0.1, 1, 5), np.geomspace(1.01, 1e10, 100)])
    region = np.select([energy <= 0.03, energy < 0.05, energy < 3e3], [1, 2, 3], 4)

    # Hertz's law has no highest frequency but a slope of 0.1 far up.
    last = {"bilinear": BILINEAR_LIMIT * limit, "hertz": 21000.0}[law]
    last_slope = {"bilinear": 0.0, "hertz": 0.1 * limit}[law]
    frequency = np.where(region == 1, 474.25, last * (energy / energy[-1]) ** 0.1)
    slope = np.where(region == 1, flat, last_slope) * frequency / energy

    kind = np.zeros(len(energy), np.int8)
    kind[np.nonzero(region == 2)[0][:folds]] = 1

    folder = root / f"nnm-{law}"
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(folder / "branch-out-of-phase.h5", "w") as file:
        file["energy"] = energy
        file["frequency"] = frequency
        file["slope"] = slope
        file["region"] = region
        file["kind"] = kind
        file["multiplier_max"] = np.where(region == 2, multiplier, 1.0)
        file.attrs["fits"] = json.dumps({"III": {"exponent": -1.0, "adjusted_r2": r2, "points": 40}})
        contacts = f'[contacts]\nlaw = "{law}"\nmodulus = 1e8\nrestitution = 1.0\n'
        file.attrs["case"] = f'[lattice]\npreset = "four-band"\nreading = "printed"\n{contacts}[nnm]\nmodes = [2]\n'


def test_branches_with_folds_and_limits_hold(tmp_path):
    """Claim C15 holds for branches that meet all its criteria, and is unmeasured in a reading without files."""
    for law in ("hertz", "bilinear"):
        put_branch(tmp_path, law)
    found = measure("C15", tmp_path, "printed")
    assert found.verdict == HOLDS, found
    assert found.value["high-energy limit (Hz), bilinear"] == pytest.approx(10252.6, abs=0.1)
    assert measure("C15", tmp_path, "calibrated").verdict == UNMEASURED


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"flat": 1.1e-6}, IN_PART),
        ({"r2": 0.949}, IN_PART),
        ({"limit": 1.011}, IN_PART),
        ({"multiplier": 1.0005}, IN_PART),
        ({"folds": 1}, IN_PART),
    ],
)
def test_branches_on_either_side_of_their_thresholds_decide(tmp_path, change, expected):
    """Claim C15 holds just inside each of its thresholds and holds in part just outside."""
    put_branch(tmp_path, "hertz")
    put_branch(tmp_path, "bilinear", **change)
    assert measure("C15", tmp_path, "printed").verdict == expected


def put_backbone(root: Path, exponent: float, scatter: float) -> None:
    """Write a transfer that is a power of the energy with logarithmic ``scatter``, and a branch's slope, a power -1."""
    branch_energy = np.geomspace(0.03, 1e6, 60)
    energy = np.geomspace(0.1, 1e4, 12)
    rough = np.exp(scatter * (-1.0) ** np.arange(12))
    transfer = 0.1 * (energy / energy[0]) ** exponent * rough
    fit = power_law(energy, transfer)
    low, high = fit.exponent_interval

    folder = root / "interband"
    folder.mkdir()
    with h5py.File(folder / "backbone.h5", "w") as file:
        for law in ("hertz", "bilinear"):
            group = file.create_group(f"calibrated-{law}-5-sites-30-cycles")
            group["energy"] = energy
            group["ibtet"] = transfer
            group["fitted"] = np.ones(12, np.int8)
            group["branch/energy"] = branch_energy
            group["branch/slope"] = 10.0 / branch_energy
            group["branch/region"] = np.full(60, 3)
            group.attrs.update(
                {
                    "exponent": fit.exponent,
                    "exponent_low": low,
                    "exponent_high": high,
                    "slope_exponent": -1.0,
                    "divisor": 1e3,
                    "floor": 0.0,
                    "r2_adjusted": fit.r2_adjusted,
                    "branch_reading": "calibrated",
                }
            )


@pytest.mark.parametrize(
    ("exponent", "scatter", "expected"), [(-1.0, 0.0, HOLDS), (-0.5, 0.0, IN_PART), (-0.5, 3.0, FAILS)]
)
def test_transfer_is_compared_with_the_slope_of_the_branch(tmp_path, exponent, scatter, expected):
    """Claim C16 holds if transfer and slope have the same exponent, -1, and fails if the transfer is no power law."""
    put_backbone(tmp_path, exponent, scatter)
    found = measure("C16", tmp_path)
    assert found.verdict == expected, found
    # Alternating factors of e^3 shift the fit of twelve points.
    tolerance = 0.3 if scatter else 1e-6
    assert found.value["exponent of the transfer, hertz"] == pytest.approx(exponent, abs=tolerance)
    assert measure("C16", tmp_path, "printed").verdict == UNMEASURED
