"""What ``validate`` warns of: each sentence where it belongs, with its numbers, and none for the cases of the paper."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import Case, LawCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.predict import PredictCase
from vipetsc.lattice import Contact

SILENT = ("diatomic", "four-band", "four-band-bilinear", "interband", "interband-one-site", "packet", "chirp",
          "disorder", "prediction", "law", "optimise-gate")  # fmt: skip


@pytest.mark.parametrize("name", SILENT)
def test_cases_that_are_as_they_should_be(name):
    assert Case.load(f"runs/{name}.toml").warnings() == []


def test_the_built_in_cases():
    for preset in ("four-band", "diatomic"):
        for reading in ("printed", "calibrated"):
            assert Case.from_table({"lattice": {"preset": preset, "reading": reading}}).warnings() == []


def told(**sections) -> list[str]:
    return small_case(**{"time": {"end": 0.04}} | sections).warnings()


def test_a_wave_that_comes_back():
    (sentence,) = told(time={"end": 0.09})
    # At 428.7 cells/s, 23 cells to the end, 11 back to cell 13.
    assert "meets the right end at 0.05365 s and is back at the site in cell 13 at 0.07931 s" in sentence
    assert "lattice.cells" in sentence
    assert told(time={"end": 0.09}, lattice={"ends": "periodic"}) == []
    assert told(time={"end": 0.079}) == []
    assert "back at the cell 20 at" in told(contacts={"sites": []}, output={"window": [2, 20]}, time={"end": 0.09})[0]
    in_the_midst = told(drive={"cell": 20, "cycles": 1}, time={"end": 0.2}, contacts={"sites": [18]})
    assert ["left end" in sentence for sentence in in_the_midst] == [True, False]
    assert len(told(drive={"cell": 20, "cycles": 6}, time={"end": 0.2}, contacts={"sites": [18]})) == 1


def test_waves_that_hardly_move():
    def of(frequency, **more):
        return told(drive={"frequency": frequency}, time={"end": 0.04}, **more)

    assert "lies in no pass band" in of(1490.0)[0]
    low = next(sentence for sentence in of(600.0) if "at an edge of band 1" in sentence)
    assert "29.9 of 516 cells/s" in low
    assert not any("at an edge" in sentence for sentence in of(700.0))


def test_a_wave_longer_than_the_lattice():
    sentence, *_ = told(drive={"frequency": 100.0, "cycles": 1}, time={"end": 0.07})
    assert "lattice.cells = 24 hold 0.741 wavelengths of 32.37 cells" in sentence and "0.262 rad/cell" in sentence
    assert told(drive={"frequency": 100.0, "cycles": 1}, time={"end": 0.07}, lattice={"cells": 130}) == []


def test_a_drive_that_samples_do_not_show():
    chirp = {"waveform": "chirp", "frequency": 1000.0, "bandwidth": 100.0, "duration": 0.03, "cycles": 30}
    assert told(drive=chirp) == []
    burst = {"frequency": 1000.0, "cycles": 6}
    fast = {"waveform": "harmonic", "frequency": 4000.0, "cell": 2, "ramp": 0.01}
    (sentence,) = told(drive=burst | {"more": [fast]}, time={"end": 0.04, "sample_interval": 8.5e-4})
    assert "4000 rad/s are beyond the 3696 rad/s" in sentence


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
def test_the_time_of_a_contact(law):
    contact, mass, speed = Contact(law, 1e6), 0.01, 0.3
    n = contact.onset_exponent
    deepest = ((n + 1) * mass * speed**2 / (2e6)) ** (1 / (n + 1))
    x = deepest * (1 - np.linspace(1, 0, 200_001) ** 2)
    rate = speed * np.sqrt(1 - (x / deepest) ** (n + 1) + 1e-300)
    middle = 0.5 * (x[1:] + x[:-1])
    slow = 2 * np.sum(np.diff(x) / (speed * np.sqrt(1 - (middle / deepest) ** (n + 1))))
    assert rate[0] == speed
    assert contact.impact_time(speed, mass) == pytest.approx(slow, rel=1e-4)


def test_contacts_that_are_brief():
    (sentence,) = told(contacts={"modulus": 1e12})
    assert "of a sample interval: both engines step through it" in sentence
    (sentence,) = told(petsc={"ts_adapt_type": "none", "ts_dt": "1e-4"})
    assert "ts takes fixed steps of 0.0001 s" in sentence and "the propagator" in sentence
    assert told(petsc={"ts_adapt_type": "none", "ts_dt": "1e-5"}) == []


def test_verbs_warn_of_what_concerns_them():
    sparse = ["output.every=2"]
    assert "one cell in 2" in Case.load("runs/law.toml", sparse).warnings()[0]
    assert LawCase.load("runs/law.toml", sparse).warnings() == []
    assert NfrcCase.load("runs/nfrc.toml", sparse).warnings() == []
    search = OptimiseCase.load("runs/optimise-clearances.toml", sparse)
    assert search.warnings() == search.base.warnings() != []

    (sentence,) = PredictCase.load("runs/predict.toml", ["output.every=2", "time.end=20.0"]).warnings()[:1]
    assert "before time.end" in sentence
