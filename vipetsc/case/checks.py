"""Checks between the keys of a case, each of which is valid by itself."""

from typing import Any

import numpy as np

from vipetsc.case.reading import Problem
from vipetsc.case.resolve import site_cells
from vipetsc.case.schema import ContactsTable, DriveTable, LatticeTable, OutputTable, Span, TimeTable
from vipetsc.lattice import pass_bands
from vipetsc.lattice.cell import UnitCell, cell_problems


class Checks:
    """Problems between keys; a check that rests on a key in ``invalid`` is left out."""

    def __init__(self, invalid: set[str]) -> None:
        self.invalid = invalid
        self.problems: list[Problem] = []

    def valid(self, *keys: str) -> bool:
        """Whether neither any of ``keys`` nor a key inside it is invalid."""
        return not any(i == k or i.startswith((f"{k}.", f"{k}[")) for i in self.invalid for k in keys)

    def require(self, condition: bool, key: str, value: Any, remedy: str) -> None:
        """Note a problem of ``key`` unless ``condition`` holds."""
        if not condition and self.valid(key):
            self.problems.append(Problem(key, value, remedy))


def check_lattice(checks: Checks, lattice: LatticeTable) -> UnitCell | None:
    """Check the unit cell; returns it if it is valid."""
    keys = ("lattice", "lattice.preset", "lattice.cell", "lattice.reading", "lattice.lambda", "lattice.eta")
    if not checks.valid(*keys):
        return None
    both = lattice.preset is not None and lattice.cell is not None
    checks.require(not both, "lattice.preset", lattice.preset, "give a preset or [lattice.cell], not both")
    for key, value in (("lattice.lambda", lattice.lam), ("lattice.eta", lattice.eta)):
        fits = value is None or lattice.preset == "four-band"
        checks.require(fits, key, value, "only the four-band preset has it")
    wrong = cell_problems(*lattice.cell.arguments()) if lattice.cell else []
    checks.problems += [Problem(f"lattice.cell.{key}", None, message) for key, message in wrong]
    return None if any(p.key.startswith("lattice.") for p in checks.problems) else lattice.unit_cell()


def check_sites(checks: Checks, lattice: LatticeTable, contacts: ContactsTable) -> None:
    """Check where the contacts are, and that each has a clearance."""
    cells = site_cells(lattice, contacts)
    given, clearance = contacts.sites, contacts.clearance
    outside = [c for c in cells if not 1 <= c <= lattice.cells]
    remedy = f"outside the lattice; cells count from 1 to {lattice.cells}"
    checks.require(not outside, "contacts.sites", outside, remedy)
    overdetermined = isinstance(given, Span) and None not in (given.last, given.spacing)
    checks.require(not overdetermined, "contacts.sites.spacing", None, "give last or spacing, not both")
    twice = sorted({c for c in cells if cells.count(c) > 1})
    checks.require(not twice, "contacts.sites", twice, "named twice; a cell carries one contact pair")
    needs_span = isinstance(given, int) and given > 0 and lattice.preset is None
    remedy = "a count needs a preset; list the cells or give {first, last, count}"
    checks.require(not needs_span, "contacts.sites", given, remedy)
    if isinstance(clearance, list):
        remedy = f"one clearance for each of the {len(cells)} sites is needed"
        checks.require(len(clearance) == len(cells), "contacts.clearance", clearance, remedy)
    missing = clearance is None and lattice.preset is None and len(cells) > 0
    checks.require(not missing, "contacts.clearance", None, "missing; give the clearance in m")


def check_stiffness(checks: Checks, lattice: LatticeTable, contacts: ContactsTable) -> None:
    """Check that the contact stiffness is given once: as a number, or by the material."""
    elastic = {"modulus": contacts.modulus, "radius": contacts.radius, "poisson": contacts.poisson}
    given = [key for key, value in elastic.items() if value is not None]
    if contacts.stiffness is not None:
        remedy = f"give it or {', '.join(given)}, not both"
        checks.require(not given, "contacts.stiffness", contacts.stiffness, remedy)
    elif site_cells(lattice, contacts) and checks.valid(*(f"contacts.{key}" for key in elastic)):
        missing = [key for key in elastic if key not in given]
        remedy = f"missing; give it or also {', '.join(missing)}"
        checks.require(not missing, "contacts.stiffness", None, remedy)


def check_drive(checks: Checks, drive: DriveTable, lattice: LatticeTable, cell: UnitCell | None) -> None:
    """Check that the frequency is given in one way, and that the driven mass exists."""
    if checks.valid("drive.frequency", "drive.wavenumber", "drive.at", "drive.band", "drive"):
        by_band = drive.wavenumber is not None, drive.at is not None
        ways = (drive.frequency is not None) + sum(by_band)
        remedy = 'give one of: frequency; wavenumber and band; band and at = "max-group-velocity"'
        checks.require(ways == 1, "drive.frequency", drive.frequency, remedy)
        checks.require(any(by_band) == (drive.band is not None) or ways != 1, "drive.band", drive.band, remedy)
        if cell:
            fits = drive.band is None or drive.band <= cell.dofs
            checks.require(fits, "drive.band", drive.band, f"the cell has {cell.dofs} bands")
    inside = not checks.valid("lattice.cells") or drive.cell <= lattice.cells
    checks.require(inside, "drive.cell", drive.cell, f"outside the lattice; cells count from 1 to {lattice.cells}")
    if cell:
        checks.require(drive.mass <= cell.dofs, "drive.mass", drive.mass, f"the cell has {cell.dofs} masses")


def check_sampling(checks: Checks, time: TimeTable, output: OutputTable, cell: UnitCell | None, cells: int) -> None:
    """Check the samples against the bands and the end, and the recorded window against the lattice."""
    interval = time.sample_interval
    if checks.valid("time.sample_interval"):
        if cell and interval != "auto":
            checks.problems += too_coarse(cell, interval, "time.sample_interval", interval)
        twice = checks.valid("time.samples") and time.samples is not None and interval != "auto"
        checks.require(not twice, "time.samples", time.samples, "give it or time.sample_interval, not both")
        if checks.valid("time.end") and interval != "auto" and time.end != "traverse":
            checks.require(time.end >= interval, "time.end", time.end, "shorter than one sample interval")
    if output.window is not None and checks.valid("lattice.cells"):
        first, last = output.window
        remedy = f"must be [first, last] within cells 1 to {cells}"
        checks.require(1 <= first <= last <= cells, "output.window", output.window, remedy)


def too_coarse(cell: UnitCell, interval: float, key: str, value: Any) -> list[Problem]:
    """The problem of samples every ``interval`` s, asked for by ``key``, beyond the top band's Nyquist interval."""
    nyquist = np.pi / pass_bands(cell)[-1].high
    if interval < nyquist:
        return []
    given = "" if interval == value else f"an interval of {interval:.4g} s is "
    return [Problem(key, value, f"{given}too coarse for the bands; the top band's Nyquist interval is {nyquist:.4g} s")]
