"""A lattice of one cell: a mass between two walls that meets a stop, in runs, bands, modes and frequency responses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.conftest import run_of
from tests.rigs import TWO_MASSES, followed, period_map
from tests.steady_states import motion_at
from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.cli.case_rows import lattice_rows
from vipetsc.lattice.damped import damped_bloch
from vipetsc.lattice.modes import linear_modes

pytestmark = pytest.mark.parallel(1)

# A mass of 1 kg on two springs of 0.75 N/m, with a dashpot of 0.06 N s/m to the ground and a stop of 20 N/m at 0.4 m.
# The left wall shakes.
CELL = TWO_MASSES["lattice"]["cell"] | {"springs": [{"start": 1, "end": 1, "stiffness": 0.75, "next_cell": True}]}
ONE_MASS: dict[str, Any] = TWO_MASSES | {
    "lattice": TWO_MASSES["lattice"] | {"cells": 1, "cell": CELL},
    "contacts": TWO_MASSES["contacts"] | {"clearance": 0.4},
    "nfrc": TWO_MASSES["nfrc"] | {"range": [0.9, 2.3], "harmonics": 31},
}


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_run_is_that_of_an_oscillator(engine):
    """A run is the motion of u'' = F - 1.5 u - 0.06 u' - 20 max(u - 0.4, 0) by SciPy."""
    drive = {"waveform": "harmonic", "amplitude": 0.5, "frequency": 1.2, "cell": 1, "ramp": 5.0}
    time = {"end": 40.0, "sample_interval": 0.1, "engine": engine}
    run = run_of(Case.from_table(ONE_MASS | {"drive": drive, "time": time}))
    samples = run["time"].values
    force = Case.from_table(ONE_MASS | {"drive": drive, "time": time}).model().drives[0].waveform.force

    def rate(t: float, y: np.ndarray) -> list[float]:
        push = 20.0 * max(y[0] - 0.4, 0.0)
        return [y[1], float(force(t)) - 1.5 * y[0] - 0.06 * y[1] - push]

    solved = solve_ivp(rate, (0, 40), [0, 0], "DOP853", t_eval=samples, rtol=1e-10, atol=1e-12, max_step=0.02)
    u = run["displacement"].values[:, 0, 0]
    assert np.abs(u).max() > 0.45
    np.testing.assert_allclose(u, solved.y[0], atol=1e-6)


@pytest.mark.parametrize("ends", ["free", "fixed", "periodic"])
@pytest.mark.parametrize(
    "cell",
    [
        {"masses": [1.0]},
        # The stop is that of the first mass, which takes a second one along by a spring.
        {"masses": [1.0, 0.1], "springs": [{"start": 1, "end": 2, "stiffness": 10.0}]},
        # A second mass that nothing holds stays where it is.
        {"masses": [1.0, 0.1]},
    ],
)
def test_nothing_has_to_connect_a_single_cell(cell, ends):
    """A mass flies at 1 m/s onto an elastic stop 1 m away and comes back; alone, at the speed at which it came."""
    table = {
        "lattice": {"cells": 1, "ends": ends, "cell": cell},
        "contacts": {"stiffness": 1e6, "sites": [1], "pair": [0, 1], "side": "minus", "clearance": 1.0},
        "initial": {"kind": "velocity", "cell": 1, "velocity": -1.0},
        "time": {"end": 2.0, "sample_interval": 0.01},
    }
    case = Case.from_table(table)
    run = run_of(case)
    stored = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"]
    assert stored.values == pytest.approx(0.5, rel=1e-9)
    if "springs" not in cell:
        # The contact of 1 kg on 1e6 N/m^1.5 lasts 3.2181 (m^2/(k^2 v))^(1/5) = 0.01281 s.
        assert run["displacement"].values[-1, 0, 0] == pytest.approx(-0.012811, abs=1e-5)
        assert run["velocity"].values[-1, 0, 0] == pytest.approx(1.0, rel=1e-9)
    rows = dict(lattice_rows(case))
    assert rows["clearance"] == "1000 mm on side -"
    assert rows["lattice"].startswith("1 cell, ")
    without = Case.from_table(table | {"contacts": {"sites": []}})
    assert dict(lattice_rows(without))["contact"] == "none"
    assert not [text for text in case.warnings() if "wavelength" in text]


def test_its_only_mode():
    """The only mode of one mass has the frequency sqrt(1.5) rad/s."""
    modes = linear_modes(Case.from_table(ONE_MASS).model().chain)
    assert modes.frequency == pytest.approx([np.sqrt(1.5)])
    assert np.abs(modes.vectors) == pytest.approx(np.ones((1, 1)))


def test_dashpots_alone_resist_a_motion_of_equal_masses_together():
    """A common motion of all masses, kappa = 0, has no stiffness: of its two rates, 0 and -0.06 1/s, 0 is given."""
    cell = Case.from_table(ONE_MASS).model().chain.cell
    assert damped_bloch(cell, 0.0).rate == pytest.approx([0.0], abs=1e-12)
    # A long wave is overdamped: s^2 + 0.06 s + omega^2 = 0 has two real rates, of which the slower one is given.
    rate = damped_bloch(cell, 0.01).rate[0]
    squared = 4 * 0.75 * np.sin(0.005) ** 2
    assert rate == pytest.approx(-0.03 + np.sqrt(0.03**2 - squared), rel=1e-9)


@pytest.mark.slow
def test_its_frequency_response_comes_back_after_a_period(tmp_path):
    """States return after a period by SciPy and are stable as their multipliers are; at a fold a multiplier is 1."""
    contacts = ONE_MASS["contacts"] | {"clearance": 0.8}
    states, points = followed(NfrcCase.from_table(ONE_MASS | {"contacts": contacts}), tmp_path / "one")
    assert [point.kind for point in points].count("fold") == 2
    touching = [point for point in points if point.measured.episodes and point.kind == "regular"]
    assert len(touching) > 10
    for point in [touching[i] for i in np.linspace(0, len(touching) - 1, 10).astype(int)]:
        state = np.ravel(motion_at(states, point.xi, np.arange(1)))
        period = period_map(states, point, state)
        assert np.abs(period.end - state).max() < 1e-3 * np.abs(state).max()
        grows = np.abs(period.multipliers) > 1.001
        assert point.measured.unstable == np.count_nonzero(grows)

    # At the folds the map of a period has a multiplier of 1.
    for point in points:
        if point.kind == "fold":
            state = np.ravel(motion_at(states, point.xi, np.arange(1)))
            values = period_map(states, point, state).multipliers
            assert np.abs(values - 1).min() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["run", "bands", "nfrc"])
def test_verbs_end_without_a_complaint(verb, in_process, tmp_path):
    path = tmp_path / "one.toml"
    nfrc = {"range": [1.0, 1.1], "harmonics": 5, "points": 4}
    table = ONE_MASS | {"nfrc": ONE_MASS["nfrc"] | nfrc, "time": {"end": 40.0}}
    path.write_text(NfrcCase.from_table(table).to_toml())
    ended = in_process(verb, path, "--out", tmp_path / "out")
    assert ended.returncode == 0, ended.stderr
