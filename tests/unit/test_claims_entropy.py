"""Claims C7 to C9 on the entropy's decay with the amplitude, measured from sweeps with prescribed entropies."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.unit.claim_files import measure, put_sweep
from vipetsc.case import Case
from vipetsc.paper.claims.criteria import FAILS, HOLDS, IN_PART

SITES = [1, 2, 3, 5, 10, 20]
# Amplitude in N from which on there are contacts.
ONSET = 0.7
SPREAD = "scattering"
NEIGHBOURS = "scattering-neighbours"
SPREAD_FIT = "fraction of configurations of spread sites with adjusted R^2 >= 0.95 over 4 points or more"
LARGER_ERRORS = "fraction of configurations with larger error bars from 10 N on than at the peak"

EntropyOf = Callable[[Case], float]


def decaying_entropy(case: Case) -> float:
    """Return an entropy in bits: a floor below the onset, a jump there, and a power law of exponent -1 behind it."""
    amplitude = case.drive.amplitude
    if amplitude < ONSET:
        return 1.0
    return 1.0 + 2.0 * (amplitude / ONSET) ** -1.0


def steady_error(case: Case) -> float:
    """Return an error bar in bits that is the same at all amplitudes."""
    return 0.1


def put_entropies(
    root: Path,
    entropy: EntropyOf = decaying_entropy,
    error: EntropyOf = steady_error,
    wavenumbers: Sequence[str] = ("5pi/9",),
    neighbours: bool = True,
) -> None:
    """Write the sweeps of spread and of neighbouring sites, in which all averages of the entropy are alike."""

    def content(case: Case) -> dict[str, float]:
        bits = entropy(case)
        return {
            "entropy/energy_weighted": bits,
            "entropy/masked": bits,
            "entropy/joint": bits,
            "entropy/error": error(case),
        }

    def episodes(case: Case) -> int:
        return int(case.drive.amplitude >= ONSET)

    table = {
        "lattice": {"preset": "diatomic"},
        "drive": {"band": 2, "wavenumber": "5pi/9"},
        "sweep": {
            "measures": ["entropy"],
            "drive": {"amplitude": {"log": [0.1, 20.0], "count": 13}},
            "lattice": {"reading": ["calibrated"]},
            "contacts": {"sites": SITES},
        },
    }
    if neighbours:
        put_sweep(root / NEIGHBOURS, table, content, episodes, analyses=False)
    table["sweep"]["drive"]["wavenumber"] = list(wavenumbers)
    put_sweep(root / SPREAD, table, content, episodes, analyses=False)


def test_entropies_that_decay_as_powers_hold_everywhere(tmp_path):
    """Claims C7 to C9 hold for entropies that jump at the first contact and decay as a power, with growing errors."""
    put_entropies(tmp_path, error=lambda case: 0.1 + 0.01 * case.drive.amplitude, wavenumbers=["4pi/9", "5pi/9"])
    rows = {claim: measure(claim, tmp_path) for claim in ("C7", "C8", "C9")}
    for found in rows.values():
        assert found.verdict == HOLDS, found

    found = rows["C7"]
    assert found.value["adjusted R^2 (log-log), 5 sites, spread"] > 0.98
    # The entropy includes the floor of 1 bit, so that its fit is not exactly a power -1.
    assert found.value["exponent, 5 sites, spread"] == pytest.approx(-1.0, abs=0.25)
    # Eight amplitudes lie from 0.91 N on.
    assert found.uncertainty["points of the fit, 5 sites, spread"] == 8
    assert found.files == ["scattering/ensemble.h5", "scattering-neighbours/ensemble.h5"]


def test_entropies_without_a_power_law_hold_in_part_or_not(tmp_path):
    """Claim C7 holds in part if half of the configurations have no power law, and C9 fails with constant errors."""

    def ragged(case: Case) -> float:
        amplitude = case.drive.amplitude
        if amplitude < ONSET or len(case.contacts.sites) < 5:
            return decaying_entropy(case)
        return 2.0 + 0.9 * np.cos(9 * np.log(amplitude / ONSET)) + (amplitude < 1.3)

    put_entropies(tmp_path, entropy=ragged)

    found = measure("C7", tmp_path)
    assert found.verdict == IN_PART
    assert "with 5 sites, spread" in found.reason
    assert "not met" in found.reason
    # Three of the six configurations have fewer than five sites.
    assert found.value[SPREAD_FIT] == pytest.approx(0.5)
    assert measure("C9", tmp_path).verdict == FAILS


def test_entropies_that_only_rise_do_not_decay(tmp_path):
    """Claims C8 and C9 are not met by entropies that grow with the amplitude; reasons name what is missing."""
    put_entropies(
        tmp_path,
        entropy=lambda case: 1 + 0.1 * case.drive.amplitude,
        error=lambda case: 1 / case.drive.amplitude,
        neighbours=False,
    )

    curves = measure("C8", tmp_path)
    assert curves.verdict == FAILS
    assert "three largest amplitudes" in curves.reason

    partly = measure("C7", tmp_path)
    assert partly.verdict in (FAILS, IN_PART)
    assert "scattering-neighbours/ensemble.h5 is missing" in partly.reason

    bars = measure("C9", tmp_path)
    assert bars.value[LARGER_ERRORS] == 0
    assert "6 of 6 configurations have their peak at 10 N or above: nothing is behind it" in bars.reason
