"""Claims C11, C12, C14 and C18 on transfer to higher bands, measured from sweeps with prescribed transfer."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import xarray as xr

from tests.unit.claim_files import measure, put_sweep
from vipetsc.case import Case
from vipetsc.io.netcdf import write_netcdf
from vipetsc.paper.claims.criteria import HOLDS, IN_PART

# Amplitude in N of the first contact; the transfer jumps there and decays from there on.
ONSET = 17.0


def put_transfer(
    root: Path, maximum: float = 0.35, floor: float = 1e-4, one_site: float = 0.1, weak_below: float = 0.0
) -> None:
    """Write the transfer of five sites, of at most ``maximum``, and of one site, of at most ``one_site``.

    It falls as the power -3/2 of the amplitude from the onset on; below ``weak_below`` N it is a fiftieth of that.
    """
    table = {
        "lattice": {"preset": "four-band"},
        "drive": {"band": 2, "at": "max-group-velocity"},
        "sweep": {
            "measures": ["transfer"],
            "zip": [["contacts.sites", "drive.cycles"]],
            "lattice": {"reading": ["calibrated"]},
            "contacts": {"law": ["hertz", "bilinear"], "sites": [5, 5, 1]},
            "drive": {"cycles": [30, 15, 30], "amplitude": {"log": [1.0, 1e4], "count": 17}},
        },
    }

    def content(case: Case) -> dict[str, float]:
        amplitude = case.drive.amplitude
        highest = maximum if len(case.contacts.sites) > 1 else one_site
        if amplitude < weak_below:
            highest *= 0.02
        transfer = highest * (amplitude / ONSET) ** -1.5 if amplitude > ONSET else 0.0
        # The floor of the whole record comes from its ends, but for a fiftieth.
        return {"ibtet": 0.02 * floor + transfer, "ibtet_whole": floor + transfer}

    def episodes(case: Case) -> int:
        return int(case.drive.amplitude > ONSET)

    put_sweep(root / "interband", table, content, episodes, analyses=False)


def test_transfer_as_the_paper_has_it_holds(tmp_path):
    """Claims C11 and C14 hold for a transfer as in the paper; the floor without the record's ends is a fiftieth."""
    put_transfer(tmp_path)

    onset = measure("C11", tmp_path)
    assert onset.verdict == HOLDS
    assert onset.value["floor, hertz"] == pytest.approx(1e-4)
    assert onset.value["floor without the record's ends, hertz"] == pytest.approx(2e-6)
    assert "without the ends it is 2e-06" in onset.reason

    single = measure("C14", tmp_path)
    assert single.verdict == HOLDS
    assert single.value["correlation of 15 and 30 cycles, hertz"] == pytest.approx(1.0)
    assert single.uncertainty["amplitudes, hertz"] == 17


@pytest.mark.parametrize(
    ("rms", "loss", "onset", "expected"),
    [(0.05, 0.03, 16.0, HOLDS), (0.07, 0.03, 16.0, IN_PART), (0.05, 0.05, 16.0, IN_PART), (0.05, 0.03, 25.0, IN_PART)],
)
def test_a_prediction_holds_by_its_errors_and_its_onset(tmp_path, rms, loss, onset, expected):
    """Claim C18 holds if errors are below 0.06 decades and 0.04 and contacts begin between the same amplitudes."""
    coordinates = {"amplitude": [12.0, 20.0, 30.0]}
    data = {"predicted/upper": ("amplitude", [0.0, 0.1, 0.2]), "simulated/contact_episodes": ("amplitude", [0.0, 3, 9])}
    good = {"rms_upper": 0.01, "worst_upper": 0.2, "worst_dissipated": 0.01, "onset_amplitude": 16.0}
    changed = good | {"rms_upper": rms, "worst_dissipated": loss, "onset_amplitude": onset}
    for law, attributes in (("hertz", good), ("bilinear", changed)):
        folder = tmp_path / f"prediction-{law}"
        folder.mkdir()
        write_netcdf(folder / "prediction.h5", xr.Dataset(data, coordinates, attributes))

    found = measure("C18", tmp_path)

    assert found.verdict == expected
    assert len(found.files) == 2
    # The simulated contacts begin at 20 N.
    assert found.value["amplitudes with contact on one side alone, bilinear"] == (onset > 20)


@pytest.mark.parametrize(("weak_below", "expected"), [(0.0, 10**0.25), (90.0, 10.0)])
def test_an_onset_ends_at_half_the_maximum(tmp_path, weak_below, expected):
    """The onset is the ratio of the last amplitude on the floor and the first one at half the maximum."""
    # Amplitudes are 10^(1/4) apart: the onset takes one step, or four where the transfer is weak below 90 N.
    put_transfer(tmp_path, weak_below=weak_below)
    ratio = measure("C11", tmp_path).value["ratio of amplitudes from the floor to half the maximum, hertz"]
    assert ratio == pytest.approx(expected, rel=1e-5)


def test_transfer_of_another_size_holds_in_part(tmp_path):
    """Claims C11 and C14 hold in part if floor and maxima have other sizes than the paper's."""
    put_transfer(tmp_path, maximum=0.2, floor=1e-3, one_site=0.3)
    onset = measure("C11", tmp_path)
    assert onset.verdict == IN_PART
    assert "floor, hertz" in onset.reason

    single = measure("C14", tmp_path)
    assert single.verdict == IN_PART
    assert "maximum with one site" in single.reason


def put_amplitudes(root: Path, content: Callable[[Case], dict[str, Any]]) -> None:
    """Write a sweep of the four-band lattice over three amplitudes and both laws, which keeps its fields."""
    table = {
        "lattice": {"preset": "four-band", "cells": 30},
        "drive": {"band": 2, "at": "max-group-velocity", "cycles": 10},
        "sweep": {
            "fields": True,
            "lattice": {"reading": ["calibrated"]},
            "contacts": {"law": ["hertz", "bilinear"]},
            "drive": {"amplitude": [1.0, 24.0, 200.0]},
        },
    }
    put_sweep(root / "interband-amplitudes", table, content, episodes=lambda case: 1)


@pytest.mark.parametrize(("medium", "high", "expected"), [(0.3, 0.02, HOLDS), (0.1, 0.2, IN_PART)])
def test_medium_amplitude_fills_the_upper_bands(tmp_path, medium, high, expected):
    """Claim C12 holds if the transfer at 24 N exceeds that at 1 N and at 200 N."""
    transfer = {1.0: 1e-4, 24.0: medium, 200.0: high}
    put_amplitudes(tmp_path, lambda case: {"ibtet": transfer[case.drive.amplitude]})
    assert measure("C12", tmp_path).verdict == expected
