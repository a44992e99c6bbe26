"""Warnings of ``validate``: their conditions and numbers, and none for the cases of the paper."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import simulated, small_case
from vipetsc.case import Case
from vipetsc.case.predict import PredictCase
from vipetsc.case.wave_at_sites import wave_over_clearance
from vipetsc.lattice import Contact

SILENT = ("diatomic", "four-band", "four-band-bilinear", "interband", "interband-one-site", "packet", "chirp",
          "disorder", "prediction", "law", "optimise-gate")  # fmt: skip


@pytest.mark.parametrize("name", SILENT)
def test_cases_that_are_as_they_should_be(name):
    """The cases in ``runs`` give no warning."""
    assert Case.load(f"runs/examples/{name}.toml").warnings() == []


def warnings_of(**sections) -> list[str]:
    """Return the warnings of the small case with some sections changed; it ends before the wave comes back."""
    return small_case(**{"time": {"end": 0.04}} | sections).warnings()


def test_a_wave_that_comes_back():
    """A wave that returns from an end before the run does is named with its times and a site that it meets."""
    (sentence,) = warnings_of(time={"end": 0.09})

    # The wave travels at 428.7 cells/s, 23 cells to the end and 11 back to cell 13.
    assert "reaches the right end at 0.05365 s and returns to the site in cell 13 at 0.07931 s" in sentence
    assert "lattice.cells" in sentence


def test_a_wave_that_cannot_come_back():
    """A ring has no end to return from, and a run may end before the wave is back."""
    assert warnings_of(time={"end": 0.09}, lattice={"ends": "periodic"}) == []
    assert warnings_of(time={"end": 0.079}) == []


def test_a_wave_that_comes_back_from_either_end():
    """A short burst from the middle of a lattice is warned of for both ends, a burst of six cycles for one of them."""
    midst = {"time": {"end": 0.2}, "contacts": {"sites": [18]}}

    short = warnings_of(drive={"cell": 20, "cycles": 1}, **midst)
    assert ["left end" in sentence for sentence in short] == [True, False]

    assert len(warnings_of(drive={"cell": 20, "cycles": 6}, **midst)) == 1


def test_waves_that_hardly_move():
    """A drive in a gap, and one at the edge of a band with its velocity, are named; one inside a band is not."""

    def at_frequency(frequency: float) -> list[str]:
        return warnings_of(drive={"frequency": frequency})

    assert "lies in no pass band" in at_frequency(1490.0)[0]
    slow = next(sentence for sentence in at_frequency(600.0) if "near an edge of band 1" in sentence)
    assert "29.9 cells/s" in slow
    assert not any("near an edge" in sentence for sentence in at_frequency(700.0))


def test_waves_that_close_no_clearance_or_all_of_them():
    """A warning has the linear wave over the clearance where it is below 1 everywhere, or above 100."""
    case = small_case(time={"end": 0.04})
    ratios = wave_over_clearance(case.model()).max(axis=1)
    amplitude = case.drive.amplitude

    for factor, word in (0.99, "no contact closes"), (1.01, ""), (99.0, ""), (101.0, "times the clearance"):
        sentences = " ".join(warnings_of(drive={"amplitude": amplitude * factor / ratios.max()}))
        assert (word in sentences) if word else "clearance" not in sentences, factor


def test_the_wave_at_a_site_is_that_of_a_linear_run():
    """|w| of the wave at a site in the middle of a long lattice, without contact, is the clearance times the ratio."""
    case = small_case(
        lattice={"cells": 80}, contacts={"sites": [30], "clearance": 1.0}, time={"end": 0.12, "engine": "propagator"}
    )
    ratio = wave_over_clearance(case.model())[0]
    field = simulated(case)[0].displacement.values[:, 29]
    cell = case.lattice.unit_cell()
    w = field[:, cell.resonator] - field[:, cell.host]
    assert ratio[0] == ratio[1] == pytest.approx(np.abs(w).max(), rel=0.03)


def test_a_drive_that_samples_do_not_show():
    """A frequency beyond pi over the sample interval is named, also of a second drive; a chirp below it is not."""
    chirp = {"waveform": "chirp", "frequency": 1000.0, "bandwidth": 100.0, "duration": 0.03, "cycles": 30}
    assert warnings_of(drive=chirp) == []

    burst = {"frequency": 1000.0, "cycles": 6}
    fast = {"waveform": "harmonic", "frequency": 4000.0, "cell": 2, "ramp": 0.01}
    (sentence,) = warnings_of(drive=burst | {"more": [fast]}, time={"end": 0.0408, "sample_interval": 8.5e-4})
    # The highest frequency is pi/8.5e-4 s = 3696 rad/s.
    assert "4000 rad/s, beyond the 3696 rad/s" in sentence


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
def test_the_time_of_a_contact(law):
    """The time of an impact is twice the integral of dx/x' from the onset to the deepest indentation."""
    stiffness = 1e6
    mass = 0.01
    speed = 0.3
    contact = Contact(law, stiffness)
    n = contact.onset_exponent

    # m v^2/2 = k x^(n+1)/(n+1) at the deepest point. Steps shrink quadratically towards it, where x' vanishes.
    deepest = ((n + 1) * mass * speed**2 / (2 * stiffness)) ** (1 / (n + 1))
    x = deepest * (1 - np.linspace(1, 0, 200_001) ** 2)
    middle = 0.5 * (x[1:] + x[:-1])
    rate = speed * np.sqrt(1 - (middle / deepest) ** (n + 1))
    expected = 2 * np.sum(np.diff(x) / rate)

    assert contact.impact_time(speed, mass) == pytest.approx(expected, rel=1e-4)


def test_contacts_that_are_brief():
    """Contacts shorter than a sample interval, or than fixed steps of PETSc's integrator, are named."""
    (sentence,) = warnings_of(contacts={"modulus": 1e12})
    assert "of a sample interval: both engines resolve it" in sentence

    (sentence,) = warnings_of(petsc={"ts_adapt_type": "none", "ts_dt": "1e-4"})
    assert "ts takes fixed steps of 0.0001 s" in sentence
    assert "the propagator" in sentence

    assert warnings_of(petsc={"ts_adapt_type": "none", "ts_dt": "1e-5"}) == []


def drive_of_samples(folder, unit: float = 1.0, **keys) -> dict:
    """Return a drive of a burst at the four-band lattice's 1020 rad/s, whose file has its times in a ``unit`` (s)."""
    times = np.arange(600) * 1e-4
    values = np.sin(1020 * times) * np.sin(np.pi * times / times[-1]) ** 2
    np.savetxt(folder / "record.csv", np.column_stack([times / unit, values]), delimiter=",")
    return {"waveform": "samples", "samples": {"file": str(folder / "record.csv")}} | keys


@pytest.mark.parametrize(("unit", "span"), [(1e-3, 59.9), (1e-6, 5.99e4)])
def test_times_that_are_not_in_seconds(tmp_path, unit, span):
    """Samples far below the frequencies of the waves have a warning with the unit of time in which they would fit."""
    name = {1e-3: "ms", 1e-6: "us"}[unit]
    case = Case(lattice={"cells": 60}, contacts={"sites": 0}, drive=drive_of_samples(tmp_path, unit), time={"end": 0.1})
    (sentence,) = [sentence for sentence in case.warnings() if "in s?" in sentence]
    assert sentence.startswith("drive.samples: 95 % of their energy lies below ")
    assert "far below the waves of this lattice" in sentence
    assert f"are the times, up to {span:.4g} s, in s? In {name}, their spectrum would be largest at 10" in sentence
    assert sentence.endswith("rad/s and they would last 0.0599 s")


def test_a_run_that_ends_within_its_burst_or_ramp():
    """A run that ends within a burst has a warning, and with a harmonic drive one that ends within its ramp.

    A ramp lasts ten periods; a harmonic drive has no end.
    """
    (burst,) = (sentence for sentence in warnings_of(time={"end": 0.01}) if "before the end" in sentence)
    assert "time.end = 0.01 s is before the end of the burst, at 0.0368" in burst

    def endless(end: float) -> list[str]:
        drive = {"waveform": "harmonic", "frequency": 1000.0, "amplitude": 1.0}
        table = {"lattice": {"preset": "four-band", "cells": 60}, "drive": drive, "time": {"end": end}}
        sentences = Case.from_table({"name": "endless"} | table).warnings()
        return [sentence for sentence in sentences if "before the end" in sentence]

    assert endless(0.08) == []
    assert endless(0.06) == ["time.end = 0.06 s is before the end of the drive's ramp, at 0.0628319 s"]


def test_a_ring_on_which_the_site_is_near_the_drive_the_other_way_round():
    """A run has a warning if the burst reaches the site on a ring a second time.

    The drive is at cell 1 and the site at cell 299 of 300, two cells away: the second time is after 302 cells.
    """
    table = {
        "lattice": {"preset": "four-band", "cells": 300, "ends": "periodic"},
        "contacts": {"sites": [299], "clearance": 1e-3},
        "drive": {"cycles": 6},
        "predict": {},
    }
    model = PredictCase.from_table(table).model()

    def warned(passed_cells: float) -> bool:
        """Return whether a run that ends when the burst has passed so many cells has a warning."""
        end = passed_cells / model.speed + model.drive.duration
        return any("second time" in text for text in PredictCase.from_table(table | {"time": {"end": end}}).warnings())

    assert warned(302.5)
    assert not warned(301.5)
