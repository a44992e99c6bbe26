"""Laws that hold for every lattice, each tried on all of the zoo: energy, engines, units, signs, time, position."""

from __future__ import annotations

from functools import cache
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from tests.conftest import run_of, with_sections
from tests.units import HUGE, TINY, assert_same_motion
from tests.zoo import ZOO
from vipetsc.case import Case

ENGINES = [(name, engine) for name, kind in ZOO.items() for engine in kind.engines]
every_run = pytest.mark.parametrize(("name", "engine"), ENGINES)


@cache
def run_in_zoo(name: str, engine: str) -> xr.Dataset:
    """Return the run of a lattice of the zoo."""
    return run_of(Case.from_table(ZOO[name].table(engine)))


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
    if ZOO[name].conservative:
        assert np.abs(dissipated).max() < 1e-9 * given.max()
    else:
        assert dissipated[-1] > 1e-3 * given.max()
        assert np.diff(dissipated).min() > -1e-9 * given.max()


@pytest.mark.parametrize("name", ZOO)
def test_engines_agree(name):
    """The two engines have nothing in common but the lattice and its laws."""
    first = run_in_zoo(name, "ts")
    second = run_in_zoo(name, "propagator")
    np.testing.assert_allclose(first["velocity"], second["velocity"], rtol=0, atol=1e-6 * largest(first))
    np.testing.assert_array_equal(first["impacts/site"], second["impacts/site"])
    np.testing.assert_allclose(first["impacts/onset"], second["impacts/onset"], rtol=0, atol=1e-8)


@pytest.mark.parametrize("units", [TINY, HUGE], ids=["tiny", "huge"])
@every_run
def test_results_do_not_depend_on_units(name, engine, units):
    """No length, force or energy in the program is absolute: each bit stays where powers of numbers are exact."""
    kind = ZOO[name]
    run = run_of(Case.from_table(units.of_table(kind.table(engine), kind.key_units())))
    tolerance = 0.0
    if not kind.exact:
        tolerance = 1e-9
    assert_same_motion(run, run_in_zoo(name, engine), units, tolerance)


@pytest.mark.parametrize(("name", "engine"), [pair for pair in ENGINES if "packet" not in pair])
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
    if isinstance(value, dict):
        return {name: turned_round(item, name) for name, item in value.items()}
    if isinstance(value, list):
        return [turned_round(item, key) for item in value]
    if key == "side":
        return OTHER_SIDE[value]
    if key in ODD:
        return -value
    return value


@pytest.mark.parametrize("name", [name for name, kind in ZOO.items() if kind.mirrored])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_lattice_may_be_counted_from_its_other_end(name, engine):
    """A cell whose parts are joined to the same part of the next cell has no direction."""
    table = ZOO[name].table(engine)
    cells = table["lattice"]["cells"]

    def from_other_end(cell: int) -> int:
        return cells + 1 - cell

    changes = {"contacts": {"sites": sorted(map(from_other_end, table["contacts"]["sites"]))}}
    if "drive" in table and "cell" in table["drive"]:
        changes["drive"] = {"cell": from_other_end(table["drive"]["cell"])}
    if "initial" in table:
        changes["initial"] = {"cell": from_other_end(table["initial"]["cell"])}
        if "direction" in table["initial"]:
            changes["initial"]["direction"] = -table["initial"]["direction"]
    run = run_in_zoo(name, engine)
    image = run_of(Case.from_table(with_sections(table, changes)))
    difference = np.asarray(image["velocity"])[:, ::-1] - np.asarray(run["velocity"])
    assert np.abs(difference).max() < 1e-7 * largest(run)
    assert image.sizes["episode"] == run.sizes["episode"]


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


@pytest.mark.parametrize(("name", "engine"), [pair for pair in ENGINES if ZOO[pair[0]].linear_without_sites])
def test_motion_without_contact_is_proportional(name, engine):
    """Before the first contact twice the cause has twice the effect, bitwise."""
    table = with_sections(ZOO[name].table(engine), {"contacts": {"clearance": 1.0}})
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
