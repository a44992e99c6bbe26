"""The verdicts on the paper's claims follow from their numbers: files with known answers in, claims out."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipetsc.case import Sweep
from vipetsc.io.ensemble_file import EnsembleFile
from vipetsc.lattice import bloch, pass_bands
from vipetsc.paper.claims import measure_claims, write_claims
from vipetsc.paper.claims.claim import FAILS, HOLDS, IN_PART, UNMEASURED, Criterion, rounded, verdict
from vipetsc.paper.claims.entropy import SPREAD_LAW
from vipetsc.paper.claims.evidence import Curve, Evidence, MissingEvidence
from vipetsc.paper.claims.measure import READINGS, STATEMENTS, measured
from vipetsc.paper.claims.scattering import BRANCHES
from vipetsc.spectra import Parts, power_law
from vipetsc.studies.ensemble import COMPLETE, Outcome, assemble

IDS = [f"C{i}" for i in range(1, 18)]
SITES = [1, 2, 3, 5, 10, 20]
ONSET = 0.7  # N


def by_id(id):
    (statement,) = (s for s in STATEMENTS if s.id == id)
    return statement


def measure(id, root, reading="calibrated"):
    return measured(by_id(id), reading, Path(root))


def put_sweep(folder, table, content, episodes, work=lambda case: case.drive.amplitude**2):
    """A finished sweep in ``folder``: ``content(case)`` is each member's analysis, ``episodes(case)`` its contacts."""
    plan = Sweep.from_table(table)
    members = plan.members()
    outcomes = []
    for member in members:
        home = folder / member.id
        home.mkdir(parents=True, exist_ok=True)
        (home / "case.toml").write_text(member.case.to_toml())
        with h5py.File(home / "analysis.h5", "w") as file:
            for name, value in content(member.case).items():
                file[name] = value
                if name == "bands/energy":
                    file[name].attrs["parts"] = [f"part {i}" for i in range(len(value))]
        statistics = {"episodes": episodes(member.case), "work": work(member.case), "dissipated": 0.0}
        outcomes.append(Outcome(COMPLETE, "", statistics | {"ledger_error": 0.0}))
    index = {"members": [{"id": m.id} for m in members]}
    (folder / "index.json").write_text(json.dumps(index))
    assemble(plan, members, outcomes, folder)
    return folder


# What decides


@given(st.floats(-1e6, 1e6), st.floats(0, 1e6), st.floats(-2e6, 2e6))
def test_a_criterion_is_met_within_its_bounds_alone(low, width, value):
    criterion = Criterion("x", low, low + width)
    assert criterion.met(value) == (low - 1e-9 <= value <= low + width + 1e-9)
    assert not criterion.met(float("nan"))
    assert f"{low:.4g} to {low + width:.4g}" in str(criterion)


def test_shares_are_counted_out_of_their_number():
    criterion = Criterion("share of curves", low=4, of=6)
    assert criterion.met(4 / 6) and criterion.met(2 / 3) and not criterion.met(0.5)
    assert str(criterion) == "share of curves: at least 4 of 6"


@pytest.mark.parametrize(
    "value, expected",
    [
        ({"a": 1.0, "b": 1.0}, HOLDS),
        ({"a": 1.0, "b": 3.0}, IN_PART),
        ({"a": 3.0, "b": 1.0}, FAILS),  # a is decisive
        ({"a": 3.0, "b": 3.0}, FAILS),
        ({"a": 1.0, "b": None}, IN_PART),
        ({"a": 1.0}, IN_PART),
        ({"a": float("nan"), "b": 1.0}, FAILS),
        ({}, UNMEASURED),
    ],
)
def test_verdicts(value, expected):
    criteria = (Criterion("a", high=2, decisive=True), Criterion("b", high=2))
    assert verdict(criteria, value)[0] == expected


def test_numbers_are_rounded_and_finite():
    assert rounded({"a": 0.123456789, "b": np.float64("nan"), "c": np.int64(3), "d": None, "e": float("inf")}) == {
        "a": 0.123457,
        "b": None,
        "c": 3.0,
        "d": None,
        "e": None,
    }


@given(st.integers(2, 9), st.floats(1.1, 3.0))
def test_a_rise_is_measured_between_neighbouring_amplitudes(steps, ratio):
    amplitude = ratio ** np.arange(steps + 3)
    value = np.where(np.arange(steps + 3) < steps, 0.01, 1.0)
    curve = Curve(amplitude, value, np.zeros(steps + 3))
    assert curve.rise(0.1, 0.5) == pytest.approx(ratio)
    assert np.isnan(Curve(amplitude, value + 1, np.zeros(steps + 3)).rise(0.1, 0.5))


# All of them together


def test_without_files_nothing_is_measured_and_thresholds_stand(tmp_path):
    claims = measure_claims(tmp_path)
    assert [(c.id, c.reading) for c in claims] == [(i, r) for i in IDS for r in READINGS]
    for c in claims:
        assert c.verdict == UNMEASURED and "missing" in c.reason and not c.files and not c.value
        for criterion in by_id(c.id).criteria:
            bounds = [f"{b:.4g}" for b in (criterion.low, criterion.high) if np.isfinite(b)]
            assert str(criterion) in c.threshold and all(b in str(criterion) for b in bounds)
        assert c.figure and "{" not in c.figure and c.claim.endswith(".")


def test_json_is_strict_and_the_same_every_time(tmp_path):
    for name in ("a", "b"):
        write_claims(measure_claims(tmp_path), tmp_path / f"{name}.json")
    text = (tmp_path / "a.json").read_text()
    assert text == (tmp_path / "b.json").read_text()
    rows = json.loads(text)
    fields = {"id", "reading", "claim", "value", "uncertainty", "threshold", "verdict", "reason", "figure", "files"}
    assert len(rows) == 34 and all(row.keys() == fields for row in rows)
    assert not list(tmp_path.glob(".*.part"))


def test_a_broken_file_is_named_and_stops_no_other_claim(tmp_path):
    folder = tmp_path / "design"
    folder.mkdir()
    (folder / "design.h5").write_bytes(b"not HDF5")
    claims = {c.id: c for c in measure_claims(tmp_path)}
    assert claims["C10"].verdict == UNMEASURED and "design.h5" in claims["C10"].reason
    assert str(tmp_path) not in claims["C10"].reason
    with h5py.File(folder / "design.h5", "w") as file:
        file["reading"] = ["printed"]
    again = measure("C10", tmp_path)
    assert again.verdict == UNMEASURED and again.files == ("design/design.h5",)


def test_a_reading_that_is_not_there_is_not_measured(tmp_path):
    table = {"lattice": {"preset": "diatomic", "reading": "calibrated"}, "sweep": {"drive": {"amplitude": [0.1, 1.0]}}}
    put_sweep(tmp_path / "scattering", table, lambda case: {}, lambda case: 0)
    with Evidence(tmp_path) as evidence:
        assert evidence.place("scattering", "calibrated") == (0,)
        with pytest.raises(MissingEvidence, match="calibrated"):
            evidence.place("scattering", "printed")
        assert evidence.files == ["scattering/ensemble.h5"]


# Entropy


def law(amplitude):
    """Entropy in bits: a floor below the onset, a jump, and a power law behind it."""
    return 1.0 + 2.0 * np.where(amplitude < ONSET, 0.0, (np.maximum(amplitude, ONSET) / ONSET) ** -1.0)


def put_entropies(root, wavenumbers, entropy, error, neighbours=True):
    """Spread and neighbouring sites; ``entropy(case)`` and ``error(case)`` in bits."""

    def content(case):
        bits = entropy(case)
        averages = dict.fromkeys(("entropy/energy_weighted", "entropy/masked", "entropy/joint"), bits)
        return averages | {"entropy/error": error(case)}

    table = {
        "lattice": {"preset": "diatomic"},
        "drive": {"band": 2, "wavenumber": "5pi/9"},
        "sweep": {"measures": ["entropy"], "drive": {"amplitude": {"log": [0.1, 20.0], "count": 13}}},
    }
    table["sweep"]["lattice"] = {"reading": ["calibrated"]}
    table["sweep"]["contacts"] = {"sites": SITES}
    if neighbours:
        put_sweep(root / "scattering-neighbours", table, content, touches)
    table["sweep"]["drive"]["wavenumber"] = wavenumbers
    put_sweep(root / "scattering", table, content, touches)


def touches(case):
    return int(case.drive.amplitude >= ONSET)


def test_power_law_entropies_hold_everywhere(tmp_path):
    put_entropies(
        tmp_path,
        ["4pi/9", "5pi/9"],
        lambda case: law(case.drive.amplitude),
        lambda case: 0.1 + 0.01 * case.drive.amplitude,
    )
    for id in ("C7", "C8", "C9"):
        found = measure(id, tmp_path)
        assert found.verdict == HOLDS, found
    found = measure("C7", tmp_path)
    assert found.value["adjusted R^2 (log-log), 5 sites, spread"] > 0.98
    assert found.value["exponent, 5 sites, spread"] == pytest.approx(-1.0, abs=0.25)
    assert found.uncertainty["points of the fit, 5 sites, spread"] == 8  # from .91 N on
    assert found.files == ("scattering/ensemble.h5", "scattering-neighbours/ensemble.h5")


def test_entropies_without_a_power_law_hold_in_part_or_not(tmp_path):
    def ragged(case):
        a = case.drive.amplitude
        if a < ONSET or len(case.contacts.sites) < 5:
            return law(a)
        return 2.0 + np.cos(9 * np.log(a / ONSET)) * 0.9 + (a < 1.3)

    put_entropies(tmp_path, ["5pi/9"], ragged, lambda case: 0.1)
    found = measure("C7", tmp_path)
    assert found.verdict == IN_PART and "5 (" in found.reason and "not met" in found.reason
    assert found.value[SPREAD_LAW] == pytest.approx(0.5)
    assert measure("C9", tmp_path).verdict == FAILS


def test_entropies_that_only_rise_do_not_decay(tmp_path):
    put_entropies(tmp_path, ["5pi/9"], lambda case: 1 + 0.1 * case.drive.amplitude, lambda case: 0.1, neighbours=False)
    found = measure("C8", tmp_path)
    assert found.verdict == FAILS and "three largest amplitudes" in found.reason
    partly = measure("C7", tmp_path)
    assert partly.verdict in (FAILS, IN_PART) and "scattering-neighbours/ensemble.h5 is missing" in partly.reason


# Low, medium and high amplitude of the diatomic lattice

CELLS = 160
WAVES = 2 * np.pi * np.arange(CELLS // 2 + 1) / CELLS
KAPPA = 5 * np.pi / 9


def packet(width=0.02):
    """Energy over wavenumbers about 5 pi/9, of sum 1."""
    share = np.exp(-(((WAVES - KAPPA) / width) ** 2))
    return share / share.sum()


def put_scattering(root, new, back, beside=0.0):
    """Runs whose share ``new[i]`` is spread over all wavenumbers, and of which ``back[i]`` returns from the site.

    ``beside`` is the share of the medium run's spectrum that lies off the branches.
    """
    amplitudes = [0.1, 1.0, 10.0]
    table = {
        "lattice": {"preset": "diatomic", "cells": CELLS},
        "drive": {"band": 2, "wavenumber": "5pi/9", "cycles": 30},
        "contacts": {"sites": [81]},
        "sweep": {"fields": True, "lattice": {"reading": ["calibrated"]}, "drive": {"amplitude": amplitudes}},
    }

    def content(case):
        level = amplitudes.index(case.drive.amplitude)
        model, cell = case.model(), case.unit_cell()
        time = np.linspace(0, 4 * model.drive.duration, 400)  # the site is 1.5 of them away
        late = time > 1.5 * model.drive.duration
        share = np.where(late[:, None], (1 - new[level]) * packet() + new[level] / len(WAVES), packet())
        energy = case.drive.amplitude**2
        kinetic = np.zeros((len(time), CELLS))
        kinetic[:, 5], kinetic[:, 100] = back[level] * energy, (1 - back[level]) * energy
        frequency = np.linspace(0, 3200, 641)
        branches = bloch(cell, WAVES).frequency
        off = np.abs(frequency[None, :] - branches[:, 1:])
        dispersion = packet()[:, None] * np.exp(-((off / 6.0) ** 2))
        dispersion /= dispersion.sum()
        if level == 1:
            dispersion *= 1 - beside
            dispersion[:, -1] += beside / len(WAVES)
        bins = np.minimum((WAVES / (np.pi / 12)).astype(int), 11)
        return {
            "time": time,
            "cell": np.arange(1, CELLS + 1),
            "wavenumber": WAVES,
            "frequency": frequency,
            "wavenumber_content": energy * share,
            "dispersion": dispersion,
            "kinetic_energy": kinetic,
            "partition/snapshot": time,
            "partition/bounds": np.arange(13) * np.pi / 12,
            "partition/energy": np.bincount(bins, packet(), 12)[:, None] * np.ones(len(time)),
            "partition/error": np.full(len(time), 0.002 * (level + 1)),
            "partition/cross_share": np.full(len(time), 0.67),
        }

    def episodes(case):
        return int(new[amplitudes.index(case.drive.amplitude)] > 0)

    put_sweep(root / "scattering-amplitudes", table, content, episodes)


def test_scattering_as_the_paper_has_it_holds(tmp_path):
    put_scattering(tmp_path, (0.0, 0.5, 0.1), (0.0, 0.2, 0.8))
    for id in ("C1", "C2", "C3", "C4", "C5", "C6"):
        found = measure(id, tmp_path)
        assert found.verdict == HOLDS, found
    high = measure("C4", tmp_path).value["share of the incident energy reflected, high amplitude"]
    assert high == pytest.approx(0.8, rel=1e-3)
    assert "67 %" in measure("C6", tmp_path).reason
    assert measure("C1", tmp_path).value["wavenumber of the drive on the optical branch (rad/cell)"] == pytest.approx(
        KAPPA, rel=1e-5
    )


def test_a_linear_medium_run_scatters_nothing(tmp_path):
    put_scattering(tmp_path, (0.0, 0.0, 0.1), (0.0, 0.0, 0.2))
    scattered = measure("C3", tmp_path)
    assert scattered.verdict == FAILS and "1 N makes no contact" in scattered.reason
    assert measure("C4", tmp_path).verdict == FAILS


def test_scattering_off_the_branches_holds_in_part(tmp_path):
    put_scattering(tmp_path, (0.0, 0.5, 0.6), (0.0, 0.2, 0.8), beside=0.3)
    found = measure("C3", tmp_path)
    assert found.verdict == IN_PART
    assert found.value[BRANCHES] == pytest.approx(0.7, abs=0.02)
    assert measure("C4", tmp_path).verdict == IN_PART


def test_a_low_run_with_contacts_is_not_linear(tmp_path):
    put_scattering(tmp_path, (0.2, 0.5, 0.1), (0.0, 0.2, 0.8))
    assert measure("C2", tmp_path).verdict == FAILS
    assert measure("C1", tmp_path).verdict == UNMEASURED


# Transfer to higher bands


def put_transfer(root, top, floor=1e-4, one=0.1):
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

    def content(case):
        a, highest = case.drive.amplitude, top if len(case.contacts.sites) > 1 else one
        return {"ibtet": floor + (highest * (a / 17.0) ** -1.5 if a > 17.0 else 0.0)}

    return put_sweep(root / "interband", table, content, lambda case: int(case.drive.amplitude > 17.0))


def test_coordinates_of_a_zipped_axis_meet_in_one_member(tmp_path):
    with EnsembleFile(put_transfer(tmp_path, 0.35)) as ensemble:
        assert ensemble.place(sites=1, cycles=30)[2] == 2
        assert ensemble.place(law="bilinear", sites=5, cycles=15)[1:3] == (1, 1)
        with pytest.raises(KeyError, match="cycles"):
            ensemble.place(sites=1, cycles=15)


def test_transfer_as_the_paper_has_it_holds(tmp_path):
    put_transfer(tmp_path, 0.35)
    onset, single = measure("C11", tmp_path), measure("C14", tmp_path)
    assert (onset.verdict, single.verdict) == (HOLDS, HOLDS)
    assert onset.value["floor, hertz"] == pytest.approx(1e-4)
    assert single.value["correlation of 15 and 30 cycles, hertz"] == pytest.approx(1.0)
    assert single.uncertainty["amplitudes, hertz"] == 17


def test_transfer_of_another_size_holds_in_part(tmp_path):
    put_transfer(tmp_path, 0.2, floor=1e-3, one=0.3)
    onset, single = measure("C11", tmp_path), measure("C14", tmp_path)
    assert onset.verdict == IN_PART and "floor, hertz" in onset.reason
    assert single.verdict == IN_PART and "maximum with one site" in single.reason


@pytest.mark.parametrize("shares, expected", [((0, 0.3, 0.02), HOLDS), ((0, 0.1, 0.2), IN_PART)])
def test_medium_amplitude_and_sums_of_bands(tmp_path, shares, expected):
    amplitudes = [1.0, 24.0, 200.0]
    table = {
        "lattice": {"preset": "four-band", "cells": 30},
        "drive": {"band": 2, "at": "max-group-velocity"},
        "sweep": {
            "fields": True,
            "lattice": {"reading": ["calibrated"]},
            "contacts": {"law": ["hertz", "bilinear"]},
            "drive": {"amplitude": amplitudes},
        },
    }

    def content(case):
        time = np.linspace(0, case.time.end, 50)
        total = 1.0 + 0.2 * np.sin(40 * time)
        beat = 1 + 0.05 * np.cos(np.pi * np.arange(50))  # at instants, not on the average
        parts = len(Parts.of(pass_bands(case.unit_cell())).names)
        share = shares[amplitudes.index(case.drive.amplitude)] + 1e-4
        energy = {"bands/total": total, "bands/energy": np.tile(total * beat / parts, (parts, 1))}
        return energy | {"time": time, "ibtet": share, "bands/share": np.full(parts, share)}

    put_sweep(tmp_path / "interband-amplitudes", table, content, lambda case: 1)
    assert measure("C12", tmp_path).verdict == expected
    sums = measure("C13", tmp_path)
    assert sums.verdict == HOLDS and sums.figure.endswith("calibrated-5-sites-30-cycles-24N")
    instants = sums.value["mean error at an instant after the drive, largest of the runs"]
    assert instants == pytest.approx(0.05, rel=1e-3) and "5 %" in sums.reason


@pytest.mark.parametrize("best, expected", [((0.1, 0.5), HOLDS), ((0.1, 0.8), IN_PART), ((0.6, 0.8), IN_PART)])
def test_the_design_is_that_of_a_coarse_grid(tmp_path, best, expected):
    folder = tmp_path / "design"
    folder.mkdir()
    lam = eta = np.arange(2, 19) * 0.05
    away = np.hypot(lam[:, None] - best[0], eta[None, :] - best[1] + 0.02)
    with h5py.File(folder / "design.h5", "w") as file:
        file["reading"], file["cost"] = ["printed", "calibrated"], ["deflection", "group_velocity", "weighted"]
        file["lambda"], file["eta"] = lam, eta
        file["weighted"] = np.stack([1 - away, 1 - away])
        file["out_of_phase"] = np.ones((2, 17, 17), np.int8)
        for name, value in (("lambda", best[0]), ("eta", best[1]), ("value", 1.0)):
            file[f"optimum_{name}"] = np.full((2, 3), value)
        file["paper_value"] = np.full((2, 3), 0.9)
    for reading in READINGS:
        assert measure("C10", tmp_path, reading).verdict == expected


# Branches, and the lattice beside them


def put_branch(root, law, folds=2, multiplier=50.0, limit=1.0):
    """A branch of the printed reading with ``folds`` energy folds, ending at ``limit`` times the law's limit."""
    energy = 0.03 * np.concatenate([np.geomspace(0.1, 1, 5), np.geomspace(1.01, 1e10, 100)])
    region = np.select([energy <= 0.03, energy < 0.05, energy < 3e3], [1, 2, 3], 4)
    last = {"bilinear": 10252.6169369 * limit, "hertz": 21000.0}[law]
    frequency = np.where(region == 1, 474.25, last * (energy / energy[-1]) ** 0.1)
    slope = np.where(region == 1, 0.0, {"bilinear": 0.0, "hertz": 0.1 * limit}[law] * frequency / energy)
    kind = np.zeros(len(energy), np.int8)
    kind[np.nonzero(region == 2)[0][:folds]] = 1
    folder = root / f"nnm-{law}"
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(folder / "branch-out-of-phase.h5", "w") as file:
        file["energy"], file["frequency"], file["slope"], file["region"] = energy, frequency, slope, region
        file["kind"], file["multiplier_max"] = kind, np.where(region == 2, multiplier, 1.0)
        file.attrs["fits"] = json.dumps({"III": {"exponent": -1.0, "adjusted_r2": 0.99, "points": 40}})
        contacts = f'[contacts]\nlaw = "{law}"\nmodulus = 1e8\nrestitution = 1.0\n'
        file.attrs["case"] = f'[lattice]\npreset = "four-band"\nreading = "printed"\n{contacts}[nnm]\nmodes = [2]\n'


def test_branches_with_folds_and_limits_hold(tmp_path):
    for name in ("hertz", "bilinear"):
        put_branch(tmp_path, name)
    found = measure("C15", tmp_path, "printed")
    assert found.verdict == HOLDS, found
    assert found.value["high-energy limit (Hz), bilinear"] == pytest.approx(10252.6, abs=0.1)
    assert measure("C15", tmp_path, "calibrated").verdict == UNMEASURED


def test_a_hertz_branch_without_fold_holds_in_part_and_says_so(tmp_path):
    put_branch(tmp_path, "bilinear", limit=0.9)
    put_branch(tmp_path, "hertz", folds=0, multiplier=1.0)
    found = measure("C15", tmp_path, "printed")
    assert found.verdict == IN_PART
    assert "the hertz branch at 100 MPa has 0 energy folds" in found.reason
    assert "last frequency's relative distance from the limit, bilinear" in found.reason


@pytest.mark.parametrize("exponent, scatter, expected", [(-1.0, 0.0, HOLDS), (-0.5, 0.0, IN_PART), (-0.5, 3.0, FAILS)])
def test_transfer_beside_the_slope(tmp_path, exponent, scatter, expected):
    folder = tmp_path / "interband"
    folder.mkdir()
    known = np.geomspace(0.03, 1e6, 60)
    energy = np.geomspace(0.1, 1e4, 12)
    rough = np.exp(scatter * (-1.0) ** np.arange(12))
    with h5py.File(folder / "backbone.h5", "w") as file:
        for name in ("hertz", "bilinear"):
            group = file.create_group(f"calibrated-{name}-5-sites-30-cycles")
            transfer = 0.1 * (energy / energy[0]) ** exponent * rough
            fit = power_law(energy, transfer)
            group["energy"], group["ibtet"], group["fitted"] = energy, transfer, np.ones(12, np.int8)
            group["branch/energy"], group["branch/slope"] = known, 10.0 / known
            group["branch/region"] = np.full(60, 3)
            low, high = fit.exponent_interval
            numbers = {"exponent": fit.exponent, "exponent_low": low, "exponent_high": high, "slope_exponent": -1.0}
            about = numbers | {"divisor": 1e3, "floor": 0.0, "r2_adjusted": fit.r2_adjusted}
            group.attrs.update(about | {"branch_reading": "calibrated"})
    found = measure("C16", tmp_path)
    assert found.verdict == expected, found
    assert found.value["exponent of the transfer, hertz"] == pytest.approx(exponent, abs=0.3 if scatter else 1e-6)
    assert measure("C16", tmp_path, "printed").verdict == UNMEASURED


def put_portraits(root, second):
    """One site at three amplitudes: out of phase, ``second`` (1: as before, 0: rough), then together."""
    amplitudes = [2.0, 15.0, 1e4]
    table = {
        "lattice": {"preset": "four-band", "cells": 12},
        "drive": {"band": 2, "at": "max-group-velocity"},
        "contacts": {"sites": [4]},
        "sweep": {
            "fields": True,
            "lattice": {"reading": ["calibrated"]},
            "contacts": {"law": ["hertz", "bilinear"]},
            "drive": {"amplitude": [*amplitudes, 40.0]},
        },
    }
    folder = root / "interband-one-site"
    put_sweep(folder, table, lambda case: {"ibtet": 0.1}, lambda case: int(case.drive.amplitude > 2))
    for member in Sweep.from_table(table).members():
        time = np.arange(4000) * 2e-4
        level = member.case.drive.amplitude
        wave, rough = np.sin(member.case.drive.frequency * time), np.sin(2700.0 * time)
        velocity = np.zeros((len(time), 12, 4))
        like = {2.0: 1.0, 15.0: second, 40.0: 0.0, 1e4: None}[level]
        if like is None:
            velocity[:, 3, 1] = velocity[:, 3, 2] = wave
        else:
            velocity[:, 3, 1], velocity[:, 3, 2] = wave, -like * wave + (1 - like) * rough
        with h5py.File(folder / member.id / "run.h5", "w") as file:
            file["time"], file["cell"], file["velocity"] = time, np.arange(1, 13), velocity
            file["sites/cell"], file["energy/work"] = [4], time
            file.attrs["case"] = member.case.to_toml()


@pytest.mark.parametrize("second, expected", [(1.0, HOLDS), (0.0, IN_PART)])
def test_portraits_pass_the_regimes(tmp_path, second, expected):
    put_portraits(tmp_path, second)
    found = measure("C17", tmp_path)
    assert found.verdict == expected, found
    assert found.value["I: correlation of host and resonator, hertz"] == pytest.approx(-1.0)
    if expected == IN_PART:
        assert "at 15 N the resonator's motion has already left the linear one" in found.reason
