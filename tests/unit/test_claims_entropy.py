"""Claims C7 to C9 on the entropy's decay with the amplitude, measured from sweeps with prescribed entropies."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.unit.claim_files import measure, put_sweep
from vipetsc.case import Case
from vipetsc.paper.claims.criteria import FAILS, HOLDS, IN_PART

pytestmark = pytest.mark.slow

SITES = [1, 2, 3, 5, 10, 20]
# Amplitude in N from which on there are contacts.
ONSET = 0.7
SPREAD = "scattering"
NEIGHBOURS = "scattering-neighbours"
SPREAD_FIT = "fraction of configurations of spread sites with adjusted R^2 >= 0.95 over 4 points or more"
CURVES_FIT = "fraction of curves with adjusted R^2 >= 0.9 over 4 points or more"
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


def set_fits(root: Path, step: str, average: str = "energy_weighted", **values: float) -> None:
    """Overwrite numbers of the fits of a finished sweep."""
    with h5py.File(root / step / "ensemble.h5", "r+") as file:
        for name, value in values.items():
            file[f"normalised_fits/entropy/{average}/{name}"][...] = value


@pytest.fixture(scope="module")
def finished_sweeps(tmp_path_factory):
    """Return the folder of sweeps whose entropies decay as powers: hundreds of members, written once."""
    root = tmp_path_factory.mktemp("decaying")
    put_entropies(root, error=lambda case: 0.1 + 0.01 * case.drive.amplitude, wavenumbers=["4pi/9", "5pi/9"])
    return root


@pytest.fixture
def decaying(finished_sweeps, tmp_path):
    """Return a copy of ``finished_sweeps`` that a test may change, of the files that claims on the entropy read."""
    for step in (SPREAD, NEIGHBOURS):
        (tmp_path / step).mkdir()
        shutil.copy(finished_sweeps / step / "ensemble.h5", tmp_path / step)
    return tmp_path


@pytest.mark.slow
def test_entropies_that_decay_as_powers_hold_everywhere(decaying):
    """Claims C7 to C9 hold for entropies that jump at the first contact and decay as a power, with growing errors."""
    rows = {claim: measure(claim, decaying) for claim in ("C7", "C8", "C9")}
    for found in rows.values():
        assert found.verdict == HOLDS, found

    found = rows["C7"]
    assert found.value["adjusted R^2 (log-log), 5 sites, spread"] > 0.98
    # The entropy includes the floor of 1 bit, so that its fit is not exactly a power -1.
    assert found.value["exponent, 5 sites, spread"] == pytest.approx(-1.0, abs=0.25)
    # Eight amplitudes lie from 0.91 N on.
    assert found.uncertainty["points of the fit, 5 sites, spread"] == 8
    assert found.files == ["scattering/ensemble.h5", "scattering-neighbours/ensemble.h5"]


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of_configurations", "of_curves", "expected"), [(0.951, 0.901, HOLDS), (0.949, 0.899, IN_PART)]
)
def test_fits_on_either_side_of_their_thresholds_decide(decaying, of_configurations, of_curves, expected):
    """Claims C7 and C8 hold just above their bounds on R^2, 0.95 and 0.9, and hold in part just below."""
    for claim, r2 in (("C7", of_configurations), ("C8", of_curves)):
        for step in (SPREAD, NEIGHBOURS):
            for average in ("energy_weighted", "masked", "joint"):
                set_fits(decaying, step, average, r2_log_log=r2, r2_nonlinear=r2)
        assert measure(claim, decaying).verdict == expected


@pytest.mark.slow
@pytest.mark.parametrize(("line", "nonlinear"), [(0.95, 0.5), (0.5, 0.95), (np.nan, 0.95)])
def test_the_better_fit_counts_at_every_wavenumber(decaying, line, nonlinear):
    """A curve counts if either its line of logarithms or its nonlinear fit is above the bound."""
    set_fits(decaying, SPREAD, r2_log_log=line, r2_nonlinear=nonlinear)

    found = measure("C8", decaying)

    assert found.verdict == HOLDS
    assert found.value[CURVES_FIT] == 1
    assert found.value[f"{CURVES_FIT}, log-log line alone"] == (line > 0.9)


@pytest.mark.slow
def test_fits_of_three_points_do_not_count(decaying):
    """Fits count from four points on, and count as power laws only if no worse than the mean."""
    for points, expected in ((4, HOLDS), (3, IN_PART)):
        set_fits(decaying, SPREAD, points=points)
        assert measure("C8", decaying).verdict == expected

    # Such fits are not printed as power laws either, whatever their R^2.
    found = measure("C7", decaying)
    assert "no power law with 5 sites, spread: too few points (3)" in found.reason
    assert found.value["exponent, 5 sites, spread"] is None

    set_fits(decaying, SPREAD, points=9, r2_log_log=-0.25)
    assert "no power law with 5 sites, spread: adjusted R² -0.25" in measure("C7", decaying).reason
