"""Laws that hold for every lattice, each tried on all of the zoo: energy, engines, units, signs, time, position."""

from __future__ import annotations

from functools import cache
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from tests.conftest import InParts, StopAt, assert_same_bits, datasets, run_of, simulated, with_sections
from tests.units import HUGE, TINY, assert_same_motion
from tests.zoo import ZOO
from tests.zoo_by_scipy import is_known, motion_by_scipy
from vipetsc.case import Case
from vipetsc.dynamics import simulate

ENGINES = [(name, engine) for name, kind in ZOO.items() for engine in kind.engines]
every_run = pytest.mark.parametrize(("name", "engine"), ENGINES)


@cache
def in_zoo(name: str, engine: str) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return the run of a lattice of the zoo, and its statistics."""
    run, result = simulated(Case.from_table(ZOO[name].table(engine)))
    # An engine that refuses a case is replaced by the other one, which would be compared with itself.
    assert result.statistics["engine"] == engine
    return run, result.statistics


def run_in_zoo(name: str, engine: str) -> xr.Dataset:
    """Return the run of a lattice of the zoo."""
    return in_zoo(name, engine)[0]


def in_turn(condition: str | None = None) -> Any:
    """Return parameters of the lattices with a ``condition``, a property of their kinds; the engines take turns.

    Both engines move as one: what holds for the motions of one of them holds for those of the other.
    """
    names = [name for name, kind in ZOO.items() if condition is None or getattr(kind, condition)]
    pairs = []
    for number, name in enumerate(names):
        engines = ZOO[name].engines
        pairs.append((name, engines[number % len(engines)]))
    return pytest.mark.parametrize(("name", "engine"), pairs)


def largest(run: xr.Dataset, name: str = "velocity") -> float:
    """Return the largest absolute value of a variable."""
    return float(np.abs(run[name]).max())


def stored(run: xr.Dataset) -> np.ndarray:
    """Return the energy (time,) in J in the lattice and its contacts."""
    return np.asarray(run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"])


@every_run
def test_energy_is_balanced(name, engine):
    """The work of the drives, and what was in the lattice at first, is in it or dissipated."""
    run = run_in_zoo(name, engine)
    assert run.sizes["episode"] > 1
    energy = stored(run)
    # The energy of the initial motion counts as work.
    given = np.asarray(run["energy/work"])
    dissipated = np.asarray(run["energy/dissipated"])
    if "energy/dissipated_by_damping" in run:
        dissipated = dissipated + np.asarray(run["energy/dissipated_by_damping"])
    np.testing.assert_allclose(energy + dissipated, given, rtol=0, atol=1e-8 * given.max())
    np.testing.assert_allclose(
        run["energy/dissipated_by_site"].sum("site"), run["energy/dissipated"], rtol=1e-9, atol=1e-12 * given.max()
    )
    # No energy returns from a site, not even where its force is clipped.
    assert np.diff(run["energy/dissipated_by_site"], axis=0).min() > -1e-9 * given.max()
    if ZOO[name].conservative:
        assert np.abs(dissipated).max() < 1e-9 * given.max()
    else:
        assert dissipated[-1] > 1e-3 * given.max()
        assert np.diff(dissipated).min() > -1e-9 * given.max()


@pytest.mark.parametrize("name", [name for name, kind in ZOO.items() if len(kind.engines) == 2])
def test_engines_agree(name):
    """The two engines have nothing in common but the lattice and its laws."""
    assert_engines_agree(in_zoo(name, "propagator"), in_zoo(name, "ts"))


@pytest.mark.parametrize("name", [name for name, kind in ZOO.items() if is_known(kind.table("ts"))])
def test_the_motion_is_that_of_scipy(name):
    """SciPy's integrator finds the same motion and as many impacts, from equations written by the case's table."""
    engine = ZOO[name].engines[0]
    run = run_in_zoo(name, engine)
    expected, impacts = motion_by_scipy(name, ZOO[name].table(engine), run.sizes["time"])
    np.testing.assert_allclose(run["displacement"][::10], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    # Contacts that touch at rest have no onsets there.
    if impacts:
        assert run.sizes["episode"] == impacts


def test_engines_agree_on_half_of_the_builtin_run():
    """The built-in run has 80 impacts up to 0.44 s."""
    runs = []
    for engine in ("propagator", "ts"):
        run, result = simulated(Case.load(None, ["time.end=0.44", "time.rtol=1e-12", f"time.engine={engine}"]))
        runs.append((run, result.statistics))
    assert runs[0][1]["episodes"] > 80
    assert_engines_agree(*runs)


def assert_engines_agree(exact: tuple[xr.Dataset, dict[str, Any]], stepped: tuple[xr.Dataset, dict[str, Any]]) -> None:
    """Assert that a run and its statistics are the same by both engines: motion, impacts, energies and counts."""
    ours, statistics = exact
    theirs, counts = stepped
    # Counts come first, since arrays of different numbers of contacts cannot be compared.
    for name in ("episodes", "floored", "clipped"):
        assert statistics[name] == counts[name], name
    for name in ("site", "side"):
        np.testing.assert_array_equal(ours[f"impacts/{name}"], theirs[f"impacts/{name}"])
    for name in ("onset", "separation"):
        np.testing.assert_allclose(ours[f"impacts/{name}"], theirs[f"impacts/{name}"], rtol=0, atol=3e-8)
    for name in ("force", "loss", "impulse", "indentation", "approach_velocity"):
        # Grazing contacts have small values with large relative errors.
        atol = 1e-6 * largest(theirs, f"impacts/{name}")
        np.testing.assert_allclose(ours[f"impacts/{name}"], theirs[f"impacts/{name}"], rtol=1e-4, atol=atol)

    np.testing.assert_allclose(ours["velocity"], theirs["velocity"], rtol=0, atol=1e-6 * largest(theirs))
    for name in theirs:
        if str(name).startswith("energy/"):
            np.testing.assert_allclose(ours[name], theirs[name], rtol=0, atol=1e-7 * largest(theirs, "energy/work"))
    if "damping_quadrature" in statistics:
        lost = float(ours["energy/dissipated_by_damping"][-1])
        error = statistics["damping_quadrature_error"]
        assert statistics["damping_quadrature"] == pytest.approx(lost, abs=3 * error)
        assert error < 0.05 * lost


@in_turn()
def test_a_stopped_run_goes_on_to_the_same_bits(name, engine, tmp_path):
    """A run that is stopped in its middle and called again leaves the file of a run that goes on."""
    case = Case.from_table(ZOO[name].table(engine))
    # The time stepper looks at a request after every step, the propagator after every block of samples.
    looks = {"ts": in_zoo(name, engine)[1]["steps"] // 2, "propagator": 3}[engine]
    assert simulate(case, tmp_path / "stopped", stop=StopAt(looks), observers=[InParts]).resumable
    assert simulate(case, tmp_path / "stopped", observers=[InParts]).complete
    simulate(case, tmp_path / "whole", observers=[InParts])
    assert_same_bits(datasets(tmp_path / "whole" / "run.h5"), datasets(tmp_path / "stopped" / "run.h5"))


@pytest.mark.parametrize(("name", "engine"), [pair for pair in ENGINES if ZOO[pair[0]].scaled])
def test_results_do_not_depend_on_units(name, engine):
    """No length, force or energy in the program is absolute: each bit stays where powers of numbers are exact."""
    kind = ZOO[name]
    # Each engine has either change of units in half of the lattices.
    units = [TINY, HUGE][(list(ZOO).index(name) + (engine == "ts")) % 2]
    run = run_of(Case.from_table(units.of_table(kind.table(engine), kind.key_units())))
    tolerance = 0.0
    if not kind.exact:
        tolerance = 1e-9
    assert_same_motion(run, run_in_zoo(name, engine), units, tolerance)


@in_turn("turned")
def test_motion_changes_its_sign_with_its_cause(name, engine):
    """A lattice that is turned round, with its stops and even springs, moves the other way, to the bit."""
    run = run_in_zoo(name, engine)
    opposite = run_of(Case.from_table(turned_round(ZOO[name].table(engine))))
    for variable in ("displacement", "velocity"):
        np.testing.assert_array_equal(opposite[variable], -run[variable])
    np.testing.assert_array_equal(opposite["impacts/onset"], run["impacts/onset"])
    np.testing.assert_array_equal(opposite["impacts/side"], -run["impacts/side"])


OTHER_SIDE = {"plus": "minus", "minus": "plus", "both": "both"}
ODD = ("amplitude", "velocity", "quadratic")  # keys whose values change their sign


def turned_round(value: Any, key: str = "") -> Any:
    """Return the table of the same lattice seen from the other side: forces, motions and stops change their signs."""
    if key.endswith(".quadratic"):
        return value | {"value": -value["value"]}
    if isinstance(value, dict):
        turned = {name: turned_round(item, name) for name, item in value.items()}
        if "clearance_minus" in value:
            turned |= {"clearance": value["clearance_minus"], "clearance_minus": value["clearance"]}
        return turned
    if isinstance(value, list):
        return [turned_round(item, key) for item in value]
    if key == "side":
        return OTHER_SIDE[value]
    if key in ODD:
        return -value
    return value


@in_turn("mirrored")
def test_a_lattice_may_be_counted_from_its_other_end(name, engine):
    """A lattice with left and right exchanged moves as the mirror image."""
    run = run_in_zoo(name, engine)
    image = run_of(Case.from_table(from_other_end(ZOO[name].table(engine))))
    difference = np.asarray(image["velocity"])[:, ::-1, ::-1] - np.asarray(run["velocity"])
    assert np.abs(difference).max() < 1e-7 * largest(run)
    assert image.sizes["episode"] == run.sizes["episode"]


def from_other_end(table: dict[str, Any]) -> dict[str, Any]:
    """Return the ``table`` of a lattice whose cells, and the masses of each, are counted from the right."""
    cells = table["lattice"]["cells"] + 1
    cell = table["lattice"]["cell"]
    masses = len(cell["masses"]) + 1

    def other(mass: int) -> int:
        return masses - mass if mass else 0

    springs = []
    for spring in cell["springs"]:
        ends = {"start": other(spring["start"]), "end": other(spring["end"])}
        if spring.get("next_cell"):
            # Counted from the right, the end of a spring to the next cell comes before its start.
            ends = {"start": ends["end"], "end": ends["start"]}
        springs.append(spring | ends)
    turned = cell | {"masses": cell["masses"][::-1], "springs": springs}
    if "grounding" in cell:
        turned["grounding"] = cell["grounding"][::-1]
    contacts = {"sites": sorted(cells - site for site in table["contacts"]["sites"])}
    if "contact" in cell:
        turned["contact"] = [other(mass) for mass in cell["contact"]]
    if "pair" in table["contacts"]:
        contacts["pair"] = [other(mass) for mass in table["contacts"]["pair"]]
    changes: dict[str, Any] = {"lattice": {"cell": turned}, "contacts": contacts}
    for section in ("drive", "initial"):
        if "cell" in table.get(section, {}):
            changes[section] = {"cell": cells - table[section]["cell"]}
    if "drive" in table:
        changes["drive"]["mass"] = other(table["drive"].get("mass", 1))
    if "mass" in table.get("initial", {}):
        changes["initial"]["mass"] = other(table["initial"]["mass"])
    if "direction" in table.get("initial", {}):
        changes["initial"]["direction"] = -table["initial"]["direction"]
    return with_sections(table, changes)


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_ring_may_be_counted_from_any_cell(engine):
    """A shift around the ring changes rounding alone, also where the sites then lie on both sides of its seam."""
    table = ZOO["ring"].table(engine)
    run = run_in_zoo("ring", engine)
    cells = table["lattice"]["cells"]
    for shift in (1, 9):
        sites = [(site + shift - 1) % cells + 1 for site in table["contacts"]["sites"]]
        changes = {"contacts": {"sites": sorted(sites)}, "drive": {"cell": table["drive"]["cell"] + shift}}
        shifted = run_of(Case.from_table(with_sections(table, changes)))
        difference = np.roll(shifted["velocity"], -shift, axis=1) - np.asarray(run["velocity"])
        assert np.abs(difference).max() < 1e-7 * largest(run)


@in_turn("linear_without_sites")
def test_motion_without_contact_is_proportional(name, engine):
    """Before the first contact twice the cause has twice the effect, bitwise."""
    table = with_sections(ZOO[name].table(engine), {"contacts": {"clearance": 1.0}})
    table["contacts"].pop("clearance_minus", None)
    table["contacts"].get("each", {}).pop("clearance_minus", None)
    once = run_of(Case.from_table(table))
    for section in ("drive", "initial"):
        doubled(table.get(section, {}))
    twice = run_of(Case.from_table(table))
    np.testing.assert_array_equal(twice["velocity"], 2 * once["velocity"])
    np.testing.assert_array_equal(twice["energy/kinetic"], 4 * once["energy/kinetic"])


def doubled(section: dict[str, Any]) -> None:
    """Double the amplitudes and velocities of a ``section``, in place."""
    for key, value in section.items():
        if key in ("amplitude", "velocity"):
            section[key] = 2 * value
        elif key == "more":
            for item in value:
                doubled(item)


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize("name", ["struck", "packet"])
def test_a_conservative_motion_runs_backwards(name, engine, tmp_path):
    """With its velocities turned round at the end, a lattice goes back through its impacts to where it began."""
    table = ZOO[name].table(engine)
    run = run_in_zoo(name, engine)
    end = tmp_path / "end.h5"
    with h5py.File(end, "w") as file:
        file["displacement"] = run["end/displacement"]
        file["velocity"] = -run["end/velocity"]
        file["cell"] = run["cell"]
    table["initial"] = {"kind": "file", "path": str(end), "frequency": 550.0}

    back = run_of(Case.from_table(table))
    difference = np.asarray(back["displacement"])[::-1] - np.asarray(run["displacement"])
    assert np.abs(difference).max() < 1e-6 * largest(run, "displacement")
    assert back.sizes["episode"] == run.sizes["episode"]
