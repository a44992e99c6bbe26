"""Questions of a day in a laboratory, each answered by the commands of the manual, without a script."""

from __future__ import annotations

import csv
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import vipetsc
from tests.cli.test_python import my_lattice
from vipetsc.case import Case

# These sections follow the README's lattice: the fastest engine that can compute it, and no pictures.
PLAIN = '\n[time]\nengine = "auto"\n\n[output]\nfigures = false\n'
RESTITUTIONS = """
[sweep.contacts]
restitution = [0.3, 0.9]

[sweep.drive]
amplitude = { log = [0.5, 50.0], count = 7 }
"""
CLEARANCES = """
[sweep.contacts]
clearance = [5e-4, 1e-3, 1.5e-3, 2e-3]
restitution = [0.3, 0.6, 0.9]
"""
HARMONIC = """
[[output.points]]
name = "base"
cell = 2

[[output.points]]
name = "tip"
cell = 60

[sweep.drive]
frequency = [500.0, 900.0, 1100.0, 1420.0]
"""
SCATTER = """
[disorder]
clearance = { relative = 0.05 }

[sweep.disorder]
seed = { count = 5 }

[sweep.drive]
amplitude = [1.0, 8.0, 30.0]
"""
BEADS = """
[lattice]
cells = 50
ends = "free"

[lattice.cell]
masses = [2.05e-3]

[contacts]
stiffness = 7.4e9
sites = { first = 1, last = 49, count = 49 }
next_cell = true
side = "minus"
clearance = 0.0

[initial]
kind = "velocity"
cell = 1
velocity = 0.1

[time]
end = 1e-3
sample_interval = 1e-6
rtol = 1e-9

[output]
figures = false
"""
BRANCH = """
[nnm]
modes = [2]
energy = [0.0, 1.0]
"""
SEARCH = """
[optimise]
budget = 12
curve = [8.0]

[optimise.variables]
clearance = [3e-4, 3e-3]

[[optimise.objective]]
measure = "ibtet"
"""


@pytest.fixture
def typed(in_process, tmp_path, plain_pictures) -> Callable[[str], str]:
    """Call the program in a temporary folder, once for each line: ``typed("validate x.toml")`` returns what it prints.

    Every command must end with 0.
    """

    def call(lines: str) -> str:
        printed = ""
        for line in lines.strip().splitlines():
            ended = in_process(*shlex.split(line), cwd=tmp_path)
            assert ended.returncode == 0, f"{line}\n{ended.stdout}{ended.stderr}"
            printed += ended.stdout + ended.stderr
        return printed

    return call


@pytest.fixture
def put(tmp_path) -> Callable[..., None]:
    """Save a case file in the temporary folder: ``put(name, *sections)`` writes the sections one after another."""

    def save(name: str, *sections: str) -> None:
        (tmp_path / name).write_text("".join(sections), encoding="utf-8")

    return save


def ensemble(folder: Path) -> xr.Dataset:
    """Return the measures of a sweep."""
    with vipetsc.open(folder) as data:
        return data.load()


def pages(folder: Path) -> set[str]:
    """Return the names of the pictures in a folder of results."""
    return {path.stem for path in (folder / "figures").glob("*.png")}


def table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_restitutions_over_amplitudes_and_one_of_them_beside_a_branch(typed, put, in_process, tmp_path):
    """A sweep has a curve over the amplitude for each restitution, and a page for each with the slope of a branch."""
    put("rest.toml", my_lattice(), PLAIN, RESTITUTIONS, BRANCH)
    typed("sweep rest.toml\nplot runs/rest-sweep --fig ibtet")
    data = ensemble(tmp_path / "runs/rest-sweep")
    assert pages(tmp_path / "runs/rest-sweep") == {"ibtet-over-contacts.restitution-drive.amplitude"}

    impacts = data.contact_episodes.transpose("restitution", "amplitude").values
    lost = data.dissipated_fraction.transpose("restitution", "amplitude").values
    hit = impacts.min(axis=0) > 0
    assert not impacts[:, 0].any()
    assert hit.sum() == 4
    # Stops of lower restitution dissipate more, at every amplitude with contact.
    assert np.all(lost[0, hit] > 1.2 * lost[1, hit])

    # Another question: the sweep and the branch of the cell in one picture, for each restitution.
    printed = typed(
        "nnm rest.toml --out runs/branch --set output.figures=false\n"
        "plot runs/rest-sweep runs/branch --fig ibtet_backbone\nplot runs/rest-sweep runs/branch --fig ibtet"
    )
    drawn = {name for name in pages(tmp_path / "runs/rest-sweep") if name.startswith("ibtet_backbone")}
    assert len(drawn) == 2
    assert {restitution for restitution in ("0.3", "0.9") for name in drawn if restitution in name} == {"0.3", "0.9"}
    assert "ibtet: without the branches of runs/branch; --fig ibtet_backbone draws both" in printed

    # A branch that is too short for a comparison is refused with the key that lengthens it.
    typed("nnm rest.toml --out runs/short --set output.figures=false --set nnm.energy=[0.0,0.05]")
    refused = in_process("plot", "runs/rest-sweep", "runs/short", "--fig", "ibtet_backbone", cwd=tmp_path)
    assert refused.returncode == 2
    assert "of 3 needed; follow the branch to more energy (nnm.energy)" in refused.stderr


def test_clearances_and_restitutions_as_a_map(typed, put, in_process, tmp_path):
    """A sweep over two keys of three or more values is drawn as a map; a page without its data is refused."""
    put("map.toml", my_lattice(), PLAIN, CLEARANCES)
    typed("sweep map.toml\nplot runs/map-sweep --fig contact_episodes\nexport runs/map-sweep")
    assert pages(tmp_path / "runs/map-sweep") == {"contact_episodes-over-contacts.clearance-contacts.restitution"}

    rows = table(tmp_path / "runs/map-sweep/curves/ensemble-members.csv")
    impacts = {(row["clearance (m)"], row["restitution"]): float(row["contact_episodes"]) for row in rows}
    assert len(impacts) == 12
    # The table has numbers as the case writes them. The wider the clearance, the fewer impacts.
    for restitution in ("0.3", "0.6", "0.9"):
        counts = [impacts[clearance, restitution] for clearance in ("0.0005", "0.001", "0.0015", "0.002")]
        assert counts == sorted(counts, reverse=True)

    refused = in_process("plot", "runs/map-sweep", "--fig", "ibtet_backbone", cwd=tmp_path)
    assert refused.returncode == 2
    assert "needs branches of the same law, in a further folder, and a sweep over drive.amplitude" in refused.stderr


def test_an_own_cell_under_a_harmonic_drive_over_the_frequency(typed, put, tmp_path):
    """The transmission from cell 2 to cell 60 is far smaller at a drive's frequency in a gap than at ones in bands."""
    driven = my_lattice().replace("cycles = 10\n", 'waveform = "harmonic"\n')
    driven = "".join(line for line in driven.splitlines(keepends=True) if not line.startswith(("band =", "at =")))
    put("harmonic.toml", driven, PLAIN, 'transmission = [["base", "tip"]]\n', HARMONIC)
    typed(
        "sweep harmonic.toml --set time.end=0.4 --set contacts.clearance=1.0\n"
        "plot runs/harmonic-sweep --fig transmission_base-tip"
    )

    data = ensemble(tmp_path / "runs/harmonic-sweep")
    passed = dict(zip(data.frequency.values, data["transmission/base-tip"].values, strict=True))
    # The bands are 0-632, 717-1312 and 1529-2955 rad/s. In a gap only transients of the drive's beginning pass.
    assert passed[1420.0] < 0.3 * min(passed[500.0], passed[900.0], passed[1100.0])
    assert pages(tmp_path / "runs/harmonic-sweep") == {"transmission_base-tip-over-drive.frequency"}


def test_clearances_that_scatter_as_a_band(typed, put, tmp_path):
    """Samples of scattered clearances deviate from their mean with contacts, and not at all without contact."""
    put("scatter.toml", my_lattice(), PLAIN, SCATTER)
    typed("sweep scatter.toml\nplot runs/scatter-sweep --fig ibtet\nexport runs/scatter-sweep")
    assert pages(tmp_path / "runs/scatter-sweep") == {"ibtet-over-drive.amplitude"}

    data = ensemble(tmp_path / "runs/scatter-sweep")
    deviation = data["statistics/ibtet/deviation"].values
    assert deviation[0] == 0
    assert np.all(deviation[1:] > 0.01 * data["statistics/ibtet/mean"].values[1:])
    rows = table(tmp_path / "runs/scatter-sweep/curves/ensemble-amplitude.csv")
    assert [float(row["statistics/ibtet/deviation"]) for row in rows] == deviation.tolist()


def crossing(folder: Path, first: int, last: int) -> float:
    """Return the time in s that the largest velocity takes from cell ``first`` to cell ``last``.

    Each arrival is the vertex of the parabola through the largest sample and its neighbours.
    """
    with vipetsc.open(folder) as run:
        time = run.time.values
        arrivals = []
        for cell in (first, last):
            speed = run.velocity.sel(cell=cell).isel(dof=0).values
            k = int(speed.argmax())
            a, b, c = speed[k - 1 : k + 2]
            arrivals.append(time[k] + 0.5 * (a - c) / (a - 2 * b + c) * (time[1] - time[0]))
    return arrivals[1] - arrivals[0]


@pytest.mark.parametrize(
    ("changes", "exponent"),
    [("", 1.5), (" --set contacts.law=power --set contacts.exponent=2 --set contacts.stiffness=3e13", 2)],
)
def test_struck_beads(typed, put, tmp_path, changes, exponent):
    """A struck bead excites a solitary wave, whose speed grows as the bead's velocity to the power (n - 1)/(n + 1)."""
    put("beads.toml", BEADS)
    typed(f"run beads.toml --out slow{changes}\nrun beads.toml --out fast{changes} --set initial.velocity=0.8")

    # Nesterenko's law follows from dimensions: beads of mass m that just touch, with F = k x^n, have no other
    # parameters than m, k, their distance and the velocity v. The velocities differ by a factor of 8.
    ratio = crossing(tmp_path / "slow", 15, 40) / crossing(tmp_path / "fast", 15, 40)
    assert ratio == pytest.approx(8 ** ((exponent - 1) / (exponent + 1)), rel=1e-3)


def test_a_measured_force_and_its_units(typed, put, tmp_path):
    """A record with times in ms brings a question about their unit; one in s drives the lattice without a warning."""
    typed("examples waveform")
    rows = [line.split(",") for line in (tmp_path / "waveform.csv").read_text().splitlines()]
    put("ms.csv", "time (ms), force\n", *(f"{float(time) * 1e3!r},{value}\n" for time, value in rows[1:]))

    asked = typed("validate waveform.toml --set drive.samples.file=ms.csv")
    question = "up to 61.4 s, in s? In ms, their spectrum would be largest at 1020 rad/s"
    assert question in asked
    printed = typed("validate waveform.toml\nrun waveform.toml --set output.figures=false")
    assert "warning" not in printed
    with vipetsc.open(tmp_path / "runs/waveform") as run:
        assert float(run["energy/work"][-1]) > 0
        # The run's own case holds the samples: it can be repeated without their file.
        assert Case.of(run).drive.samples.time[1] == float(rows[2][0])


def test_a_breather(typed, put, tmp_path):
    """A run that begins with a breather of a branch keeps its energy, and the motion stays at its site."""
    small = "--set nnm.points=3 --set nnm.start_frequency=[1420.0] --set nnm.orbits_at=[] --set output.figures=false"
    begun = "--set initial.orbit=1 --set time.end=0.05 --set output.figures=false"
    typed("examples breather gallery/breather-run")
    typed(f"nnm breather.toml --out runs/breather {small}\nrun gallery/breather-run.toml {begun}")

    with vipetsc.open(tmp_path / "runs/breather-run") as run:
        energy = (run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"]).values
        assert energy == pytest.approx(energy[0], rel=1e-8)
        speed = np.abs(run.velocity).max(("time", "dof")).values
        cells = run.cell.values
    assert cells[speed.argmax()] == 100
    # In the gap between bands 2 and 3 the breather decays as exp(-0.2 n) with the distance of n cells from its site:
    # to exp(-4) = 0.018 at 20 cells.
    assert speed[np.abs(cells - 100) > 20].max() < 0.03 * speed.max()


def test_the_best_clearances(typed, put, tmp_path):
    """A search leaves a case file of its best design, and a run of that case has the objective of the search."""
    put("search.toml", my_lattice(), PLAIN, SEARCH)
    typed("optimise search.toml\nrun runs/search-optimise/best.toml --out runs/best --set output.figures=false")
    with vipetsc.open(tmp_path / "runs/search-optimise") as found:
        values = found["value"].values.ravel()
    with vipetsc.open(tmp_path / "runs/best/analysis.h5") as measured:
        assert float(measured["ibtet"]) == pytest.approx(values.max(), rel=1e-6)
    assert values.max() > 1.3 * values[0]

    case = tomllib.loads((tmp_path / "runs/search-optimise/best.toml").read_text(encoding="utf-8"))
    assert len(case["contacts"]["clearance"]) == 2


IMPACTING = (
    "--set output.lyapunov=true --set time.end=150.0 --set sweep.drive.frequency=[2.5,2.88] --set output.figures=false"
)


def test_bifurcations_sections_and_exponents(typed, tmp_path):
    """The impact oscillator upwards and downwards on one page, its exponents, and a section of one member."""
    typed(
        "examples impact-oscillator\n"
        f"sweep impact-oscillator.toml --out up {IMPACTING}\n"
        f"sweep impact-oscillator.toml --out down {IMPACTING} --set sweep.follow=down\n"
        "plot down up --fig bifurcation\nrun up --member 0 --out one\nplot one --fig poincare"
    )
    data = ensemble(tmp_path / "up")
    calm, chaotic = data["lyapunov"].values
    # One impact a period: both multipliers have the size of the restitution, 0.8.
    assert calm == pytest.approx(np.log(0.8) * 2.5 / (2 * np.pi), abs=0.02)
    assert chaotic > 0.03
    assert "bifurcation" in pages(tmp_path / "down")
    assert "poincare" in pages(tmp_path / "one")

    figure = vipetsc.plot(tmp_path / "one", "poincare")
    section = figure.axes[0].lines[0].get_xydata()
    assert len(section) >= 28
    # The motion repeats after each period.
    assert np.ptp(section, axis=0).max() < 1e-3


def test_impacts_as_a_table_and_points_of_two_runs(typed, put, tmp_path):
    """A row for each impact, whose losses sum to that of the run; a named point of two runs on a page."""
    put("mine.toml", my_lattice(), PLAIN, '[[output.points]]\nname = "tip"\ncell = 40\n')
    typed(
        "run mine.toml --out loud --set time.end=0.06\nrun mine.toml --out soft --set time.end=0.06"
        " --set drive.amplitude=1.0\nexport loud\n"
        "plot loud soft --fig points --db --unit Hz --width 86mm --no-title --label tip=Sensor"
    )
    impacts = vipetsc.impacts(tmp_path / "loud")
    with vipetsc.open(tmp_path / "loud") as run:
        assert impacts["loss"].sum() == pytest.approx(float(run["energy/dissipated"][-1]), rel=1e-6)
    assert len(table(tmp_path / "loud/curves/run-impacts.csv")) == len(impacts) > 0
    assert any(name.startswith("points") for name in pages(tmp_path / "loud"))


def test_a_measured_acceleration_shakes_a_lattice(typed, tmp_path):
    """The table's motion is integrated from a record in g and ms, with an offset of 0.195 m/s^2 that is removed."""
    typed("examples accelerogram")
    printed = typed("run accelerogram.toml --set output.figures=false --set time.end=0.2")
    assert "offset 0.1946 m/s^2" in " ".join(printed.split())
    with vipetsc.open(tmp_path / "runs/accelerogram") as run:
        first, last = np.abs(run["points/displacement"]).max("time").values
    # A stop 2e-4 m from the last mass holds it on one side.
    assert first > last > 2e-4


def test_a_linear_frequency_response(typed, tmp_path):
    """Four masses between frames resonate at 2 sqrt(k/m) sin(n pi/10); in dB and Hz, as wide as a column."""
    typed("examples linear-response\nnfrc linear-response.toml --out response")
    typed("plot response --db --unit Hz --width 86mm --no-title")
    rows = table(next((tmp_path / "response").glob("branch-*.csv")))
    frequency = np.array([float(row["frequency"]) for row in rows])
    size = np.array([float(row["peak_displacement/first"]) for row in rows])
    peaks = frequency[1:-1][(size[1:-1] > size[:-2]) & (size[1:-1] > size[2:])]
    assert peaks == pytest.approx(2 * 400.0 * np.sin(np.arange(1, 5) * np.pi / 10), abs=1.0)
    assert any(name.startswith("outputs") for name in pages(tmp_path / "response"))


def test_a_run_goes_on(typed, put, tmp_path):
    """A run that is extended has the bits of a longer one."""
    put("mine.toml", my_lattice(), PLAIN)
    typed(
        "run mine.toml --out short --set time.end=0.04\nrun mine.toml --out short --set time.end=0.06 --extend\n"
        "run mine.toml --out long --set time.end=0.06"
    )
    with vipetsc.open(tmp_path / "short") as short, vipetsc.open(tmp_path / "long") as whole:
        assert len(short["impacts/onset"]) > 0
        assert short.equals(whole)
