"""The scattering law of one site: waves by band and direction, shares that sum to one, what does not change them."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import assert_same_bits, datasets
from vipetsc.case import Case, CaseError, LawCase
from vipetsc.case.verb_cases import load_every
from vipetsc.dynamics import simulate
from vipetsc.figures.registry import draw
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.records import read_records
from vipetsc.io.store import RunMemory
from vipetsc.lattice import Chain, ToneBurst, bloch, four_band, waves_at
from vipetsc.lattice.packet import packet_speeds
from vipetsc.parallel import StopRequest
from vipetsc.spectra import by_direction, upper_share, wave_energies
from vipetsc.studies.one_site import ScatteringRuns, make_law
from vipetsc.studies.pair_motion import largest_between
from vipetsc.studies.scattering_law import POINT_LAYOUT, ScatteringLaw, ScatteringOutcome, matched_clearances

THREE = {
    "masses": [0.010, 0.004, 0.002],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 2e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 6e3},
        {"start": 2, "end": 3, "stiffness": 1e3},
    ],
    "contact": [2, 3],
}
LATTICES = {"four-band": {"preset": "four-band"}, "diatomic": {"preset": "diatomic"}, "three-mass": {"cell": THREE}}
COARSE = {"largest": 2.0, "samples": 1, "tolerance": 0.3, "finest": 0.2}


def case(lattice="four-band", law=COARSE, **sections) -> LawCase:
    table = {
        "lattice": LATTICES[lattice],
        "contacts": {"sites": [2], "clearance": 1e-3, "restitution": 1.0},
        "drive": {"cycles": 8, "band": 2, "at": "max-group-velocity"},
        "time": {"rtol": 1e-9},
        "law": law,
    }
    if lattice == "three-mass":
        table["contacts"] |= {"stiffness": 5e6}
    for name, values in sections.items():
        table[name] = table.get(name, {}) | values
    return LawCase.from_table(table)


def shares(runs: ScatteringRuns, *points: float) -> np.ndarray:
    """Shares (point, ...) of single runs: band and direction, then dissipated and contact."""
    runs.make([*points])
    runs.jittered = lambda z: [z]
    rows = [runs.outcomes(z)[0] for z in points]
    return np.array([[*row["share"].ravel(), row["dissipated"], row["contact"]] for row in rows])


def make_runs(folder, of: LawCase) -> ScatteringRuns:
    return ScatteringRuns(of, folder, MPI.COMM_SELF, StopRequest())


@pytest.mark.parametrize("cell", [case(name).lattice.unit_cell() for name in LATTICES], ids=[*LATTICES])
@pytest.mark.parametrize("cells", [24, 25])
def test_wave_energies_sum_to_the_lattices_and_go_where_the_wave_goes(cell, cells):
    rng = np.random.default_rng(1)
    u, v = rng.normal(size=(2, cells, cell.dofs))
    energy, speed = wave_energies(cell, u, v)
    chain = Chain(cell, cells, "periodic")
    whole = 0.5 * (chain.masses() @ v.ravel() ** 2 + u.ravel() @ chain.stiffness_matrix() @ u.ravel())
    assert energy.sum() == pytest.approx(whole, rel=1e-12)
    assert by_direction(energy, speed).sum() == pytest.approx(whole, rel=1e-12)
    kappa, n = 2 * np.pi * 5 / cells, np.arange(cells)
    for sign in (1, -1):
        point = bloch(cell, sign * kappa)
        wave = np.exp(1j * sign * kappa * n)[:, None] * point.vectors[:, 1]
        one = by_direction(*wave_energies(cell, wave.real, (-1j * point.frequency[1] * wave).real))
        side = 0 if point.group_velocity[1] > 0 else 1
        assert one[1, side] == pytest.approx(one.sum(), rel=1e-12)


def test_the_spectrum_of_a_burst_is_its_transform():
    burst = ToneBurst(3.0, 100.0, 5)
    t, dt = np.linspace(0, burst.duration, 200_001, retstep=True)
    w = np.array([0.0, 30.0, 80.0, 100.0, 120.0, 333.0])
    expected = np.exp(-1j * np.outer(w, t)) @ burst.force(t) * dt
    np.testing.assert_allclose(burst.spectrum(w), expected, atol=1e-5 * np.abs(expected).max())


def test_speeds_of_a_packet_are_those_of_its_frequency():
    cell = four_band("calibrated")
    band, slow, fast = packet_speeds(cell, ToneBurst(1.0, 900.0, 2000), 0)
    ((of_band, _, speed),) = waves_at(cell, 900.0)
    assert band == of_band - 1
    assert slow < speed < fast and fast - slow < 0.03 * speed
    assert packet_speeds(cell, ToneBurst(1.0, 900.0, 20), 0)[1] < slow


def test_the_largest_value_between_samples():
    t = np.linspace(0, 1, 41)
    assert largest_between(t, np.sin(20 * t), 20 * np.cos(20 * t)) == pytest.approx(1, abs=2e-5)


@pytest.mark.parametrize("lattice", LATTICES)
def test_shares_sum_to_one_and_nothing_happens_below_the_onset(lattice, tmp_path):
    runs = make_runs(tmp_path, case(lattice))
    quiet, met, hard = shares(runs, 0.999, 1.3, 6.0)
    band = runs.setting.band
    alone = np.zeros_like(quiet)
    alone[2 * band] = 1
    np.testing.assert_allclose(quiet, alone, atol=1e-12)
    assert runs.records[0.999]["episodes"] == 0
    for row in (met, hard):
        assert row.sum() == pytest.approx(1, abs=1e-5)
        assert row[-2] == 0 and row[2 * band] < 0.99 and row[2 * band + 1] > 1e-3  # conservative; transmits, reflects


def test_a_lossy_site_dissipates_what_is_missing(tmp_path):
    row = shares(make_runs(tmp_path, case(contacts={"restitution": 0.6})), 1.5)[0]
    assert row.sum() == pytest.approx(1, abs=1e-7) and row[-2] > 0.01


def test_the_bilinear_law_depends_on_amplitude_over_clearance_alone(tmp_path):
    tables = []
    for number, clearance in enumerate((1e-3, 3e-2)):
        folder = tmp_path / str(number)
        folder.mkdir()
        contacts = {"law": "bilinear", "clearance": clearance}
        tables.append(shares(make_runs(folder, case(contacts=contacts)), 1.2, 2.0))
    np.testing.assert_allclose(tables[0], tables[1], atol=1e-6)


def test_longer_distances_do_not_change_the_shares(tmp_path):
    tables, cells = [], []
    for settle in (2.0, 4.0):
        folder = tmp_path / str(settle)
        folder.mkdir()
        runs = make_runs(folder, case(law=COARSE | {"settle": settle}, contacts={"restitution": 0.7}))
        cells.append(runs.setting.cells)
        tables.append(shares(runs, 1.2, 2.0))
    assert cells[1] > 1.5 * cells[0]
    np.testing.assert_allclose(tables[0], tables[1], atol=1e-4)  # what had not passed by then is 4e-5


def test_a_site_below_the_drive_is_met_forward(tmp_path):
    up, down = (shares(make_runs(tmp_path / name, of), 1.2) for name, of in mirrored(tmp_path))
    np.testing.assert_allclose(up, down, atol=1e-6)


def mirrored(folder):
    """The same lattice driven below and above the site; the four-band cell is its own mirror image."""
    for name, cell, mass in (("up", 1, 1), ("down", 300, 4)):
        (folder / name).mkdir()
        yield name, case(drive={"cell": cell, "mass": mass}, contacts={"restitution": 0.5, "sites": []})


@pytest.mark.slow
def test_refined_to_the_onset_and_gone_on_with(tmp_path):
    of = case(law=COARSE | {"finest": 0.01, "tolerance": 0.1, "samples": 2})
    law = make_law(of, tmp_path / "law", MPI.COMM_SELF)
    lower = law.z[:-1][(law.mean.transmitted[:-1] > 0.9) & (law.mean.transmitted[1:] <= 0.9)]
    above = law.z[np.searchsorted(law.z, lower) + 1]
    assert (above / lower < 1.01**2).all() and len(lower)
    assert law.at(0.5).transmitted == law.at(1.0).transmitted == 1 and law.at(0.5).upper == 0
    with open_netcdf(tmp_path / "law" / "law.h5", "law") as data:
        assert LawCase.of(data).to_toml() == of.to_toml()
        assert np.nanmax(data["interpolation_error"]) < 1
    assert [path.name for path in draw("law", [tmp_path / "law"])] == ["law.png"]
    # A law that was cut off, with a line that is not whole, goes on to the same bits.
    first = tmp_path / "law" / "law.h5"
    again = tmp_path / "again"
    again.mkdir()
    (again / "case.toml").write_text((tmp_path / "law" / "case.toml").read_text())
    lines = (tmp_path / "law" / "law-runs.jsonl").read_bytes().splitlines(keepends=True)
    (again / "law-runs.jsonl").write_bytes(b"".join(lines[:-3]) + lines[-3][:40])
    before = sum(1 for _ in read_records(again / "law-runs.jsonl", lambda text: None))
    make_law(of, again, MPI.COMM_SELF)
    assert_same_bits(datasets(first), datasets(again / "law.h5"))
    after = sum(1 for _ in read_records(again / "law-runs.jsonl", lambda text: None))
    assert before == len(lines) - 3 and after == len(lines)


def by_hand() -> ScatteringLaw:
    z = np.array([1.0, 1.02, 1.2, 1.5, 4.0])
    transmitted, upper = np.array([1, 0.8, 0.7, 0.7, 0.9]), np.array([0, 0.08, 0.15, 0.09, 0.01])
    share = np.zeros((5, 3, 2))
    share[:, 1, 0], share[:, 2] = transmitted, upper[:, None] / 2
    rest = 1 - transmitted - upper
    times = np.array([np.nan, 0.1, 0.1, 0.1, 0.1])
    mean = ScatteringOutcome(
        share=share,
        transmitted=transmitted,
        reflected=0 * z,
        upper=upper,
        dissipated=rest,
        contact=0 * z,
        onset=times,
        separation=times,
        release=times,
    )
    return ScatteringLaw(z, mean, mean, 1, 1e-3, 1e-4, np.zeros(1), np.zeros(1), {})


def test_between_points_the_law_is_linear_in_log_z():
    law = by_hand()
    assert set(ScatteringOutcome._fields) == set(POINT_LAYOUT)
    middle = law.at([[np.sqrt(1.2 * 1.5), 1.02], [0.1, 9.0]])
    np.testing.assert_allclose(middle.upper, [[0.12, 0.08], [0, 0.01]], atol=1e-15)
    assert middle.share.shape == (2, 2, 3, 2) and middle.onset[0, 1] == 0.1 and np.isnan(middle.onset[1, 0])
    total = middle.share.sum(axis=(-1, -2)) + middle.dissipated
    np.testing.assert_allclose(total, 1, atol=1e-15)


def test_matched_clearances_meet_each_site_at_the_best_z():
    law, linear = by_hand(), SimpleNamespace(envelope=np.linspace(1e-4, 2e-4, 50))
    z, transmitted = law.matched()
    assert (z, transmitted) == (1.2, 0.7)  # U/(1-T) = .5 there, .4 at the onset
    found = matched_clearances(law, linear, [10, 20, 30], -20.0)
    left = np.sqrt(0.7 ** np.arange(3))
    np.testing.assert_allclose(20 * linear.envelope[[9, 19, 29]] * left / found, 1.2)
    law.mean.upper[:] = 0
    with pytest.raises(ValueError, match="no band above"):
        law.matched()


@pytest.mark.parametrize(
    ("sections", "expected"),
    [
        ({"law": {"largest": 0.5}}, "law.largest = 0.5: must be greater than 1"),
        ({"law": {"sampels": 3}}, "did you mean law.samples?"),
        ({"law": {"clearance": -1.0}}, "law.clearance"),
        ({"law": {"jitter": 0.7}}, "law.jitter"),
        ({"drive": {"frequency": 1800.0}}, "lies in no pass band"),
        ({"law": {"settle": 1000.0}}, "too slow to wait for"),
        ({"law": {"distance": 20}}, "law.distance = 20: the burst must be over before"),
        ({"lattice": {"cell": THREE}, "contacts": {"stiffness": 1e6, "clearance": None}}, "law.clearance: missing"),
        ({"lattice": {"cell": THREE}, "contacts": {"clearance": 1e-3}}, "contacts.stiffness: missing"),
    ],
)
def test_nonsense_is_one_message(sections, expected):
    contacts = {k: v for k, v in sections.get("contacts", {}).items() if v is not None}
    drive = {"band": 2, "at": "max-group-velocity"} if "cell" in sections.get("lattice", {}) else {}
    table = {"lattice": {"preset": "four-band"}, "drive": drive} | sections | {"contacts": {"sites": 0} | contacts}
    if "cell" in table["lattice"]:
        table["contacts"]["sites"] = []
    with pytest.raises(CaseError) as error:
        LawCase.from_table(table)
    assert expected in str(error.value) and len(error.value.problems) == 1


def test_a_case_without_sites_gives_the_clearance_and_the_bursts_length(tmp_path):
    bare = LawCase.from_table({"contacts": {"sites": 0, "clearance": {"first": 1e-3, "last": 4e-3}}})
    assert bare.law.clearance == pytest.approx(2e-3) and bare.law.distance == 78
    assert LawCase.from_toml(bare.to_toml()).to_toml() == bare.to_toml()
    five = LawCase.load()
    assert five.law.distance == 74 and five.law.clearance == pytest.approx(10**-2.7)
    path = tmp_path / "law.toml"
    path.write_text("[law]\nsamples = 1\n")
    assert [type(of) for of in load_every(path)] == [LawCase]


@pytest.mark.slow
@pytest.mark.parametrize(("restitution", "least"), [(0.9, 0.45)])
def test_matched_sites_outdo_the_papers(restitution, least, tmp_path):
    """Ten sites at 24.33 N; the paper's five give .34."""
    contacts = {"restitution": restitution, "sites": 10}
    of = LawCase.from_table(
        {"contacts": contacts, "law": {"largest": 1.4, "samples": 1, "tolerance": 0.05, "finest": 0.02}}
    )
    law = make_law(of, tmp_path / "law", MPI.COMM_SELF)
    sites = np.array(of.contacts.sites)
    envelope = np.full(300, 1.229e-4)  # that of the linear run is the same at all ten sites within 1 %
    clearance = matched_clearances(law, SimpleNamespace(envelope=envelope), sites, 24.33)
    contacts |= {"sites": sites.tolist(), "clearance": clearance.tolist()}
    memory = RunMemory(MPI.COMM_SELF)
    simulate(
        Case.from_table({"contacts": contacts, "time": {"engine": "propagator"}, "output": {"stride": 4420}}), memory
    )
    run = memory.dataset
    model = Case.of(run).model()
    state = run["displacement"].values[-1], run["velocity"].values[-1]
    assert upper_share(model.chain, model.drive, *state, float(run["energy/work"][-1])) > least
