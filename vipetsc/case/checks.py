"""Checks between the keys of a case, each of them sound by itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from vipetsc.case.schema import ContactsTable, LatticeTable, Problem, Span
from vipetsc.lattice.bloch import pass_bands
from vipetsc.lattice.cell import UnitCell, cell_problems
from vipetsc.lattice.chain import spread_sites
from vipetsc.lattice.presets import PRESETS


def unit_cell_of(lattice: LatticeTable) -> UnitCell:
    """The unit cell of a sound ``[lattice]`` section."""
    if lattice.cell is not None:
        return lattice.cell.unit_cell()
    options = {k: v for k, v in (("lam", lattice.lam), ("eta", lattice.eta)) if v is not None}
    return PRESETS[lattice.preset].cell(lattice.reading, **options)


def cross_problems(sections: dict[str, Any], bad: set[str]) -> list[Problem]:
    """What is wrong between sound keys; a check that rests on a key in ``bad`` is left out."""
    lattice, contacts, drive = sections["lattice"], sections["contacts"], sections["drive"]
    time, output = sections["time"], sections["output"]
    problems: list[Problem] = []

    def sound(*keys: str) -> bool:
        return not any(b == k or b.startswith((f"{k}.", f"{k}[")) for b in bad for k in keys)

    def check(fine: bool, key: str, value: Any, remedy: str) -> None:
        if not fine and sound(key):
            problems.append(Problem(key, value, remedy))

    cell = None
    if sound("lattice", "lattice.preset", "lattice.cell", "lattice.reading", "lattice.lambda", "lattice.eta"):
        both = lattice.preset is not None and lattice.cell is not None
        check(not both, "lattice.preset", lattice.preset, "give a preset or [lattice.cell], not both")
        for key, value in (("lattice.lambda", lattice.lam), ("lattice.eta", lattice.eta)):
            check(value is None or lattice.preset == "four-band", key, value, "only the four-band preset has it")
        wrong = cell_problems(*lattice.cell.parts()) if lattice.cell else []
        problems += [Problem(f"lattice.cell.{key}", None, message) for key, message in wrong]
        cell = None if both or wrong or any(p.key.startswith("lattice.") for p in problems) else unit_cell_of(lattice)

    if sound("lattice.cells", "contacts.sites"):
        sites = sites_of(lattice, contacts)
        outside = [c for c in sites if not 1 <= c <= lattice.cells]
        check(
            not outside,
            "contacts.sites",
            outside,
            f"outside the lattice; cells count from 1 to {lattice.cells}",
        )
        doubled = isinstance(contacts.sites, Span) and None not in (contacts.sites.last, contacts.sites.spacing)
        check(not doubled, "contacts.sites.spacing", None, "give last or spacing, not both")
        twice = sorted({c for c in sites if sites.count(c) > 1})
        check(not twice, "contacts.sites", twice, "named twice; a cell carries one contact pair")
        needs_span = isinstance(contacts.sites, int) and contacts.sites > 0 and lattice.preset is None
        remedy = "a count needs a preset; list the cells or give {first, last, count}"
        check(not needs_span, "contacts.sites", contacts.sites, remedy)
        clearance = contacts.clearance
        if isinstance(clearance, list):
            remedy = f"one clearance for each of the {len(sites)} sites is needed"
            check(len(clearance) == len(sites), "contacts.clearance", clearance, remedy)
        missing = clearance is None and lattice.preset is None and len(sites) > 0
        check(not missing, "contacts.clearance", None, "missing; give the clearance in m")
        elastic = {"modulus": contacts.modulus, "radius": contacts.radius, "poisson": contacts.poisson}
        given = [k for k, v in elastic.items() if v is not None]
        if contacts.stiffness is not None:
            check(
                not given,
                "contacts.stiffness",
                contacts.stiffness,
                f"give it or {', '.join(given)}, not both",
            )
        elif sites and len(given) < 3 and sound(*(f"contacts.{k}" for k in elastic)):
            lacking = [k for k in elastic if k not in given]
            check(False, "contacts.stiffness", None, f"missing; give it or also {', '.join(lacking)}")

    ways = [drive.frequency is not None, drive.wavenumber is not None, drive.at is not None]
    if sound("drive.frequency", "drive.wavenumber", "drive.at", "drive.band", "drive"):
        remedy = 'give one of: frequency; wavenumber and band; band and at = "max-group-velocity"'
        check(sum(ways) == 1, "drive.frequency", drive.frequency, remedy)
        needs = ways[1] or ways[2]
        check(needs == (drive.band is not None) or sum(ways) != 1, "drive.band", drive.band, remedy)
        if cell:
            fits = drive.band is None or drive.band <= cell.dofs
            check(fits, "drive.band", drive.band, f"the cell has {cell.dofs} bands")
    check(not sound("lattice.cells") or drive.cell <= lattice.cells, "drive.cell", drive.cell,
          f"outside the lattice; cells count from 1 to {lattice.cells}")  # fmt: skip
    if cell:
        check(drive.mass <= cell.dofs, "drive.mass", drive.mass, f"the cell has {cell.dofs} masses")
        if sound("time.sample_interval") and time.sample_interval != "auto":
            problems += too_coarse(cell, time.sample_interval, "time.sample_interval", time.sample_interval)
    if sound("time.sample_interval", "time.samples"):
        both = time.samples is not None and time.sample_interval != "auto"
        check(not both, "time.samples", time.samples, "give it or time.sample_interval, not both")
    if sound("time.sample_interval", "time.end") and time.sample_interval != "auto" and time.end != "traverse":
        check(time.end >= time.sample_interval, "time.end", time.end, "shorter than one sample interval")
    if output.window is not None and sound("lattice.cells"):
        first, last = output.window
        fits = 1 <= first <= last <= lattice.cells
        check(fits, "output.window", output.window, f"must be [first, last] within cells 1 to {lattice.cells}")
    return problems


def too_coarse(cell: UnitCell, interval: float, key: str, value: Any) -> list[Problem]:
    """The problem of samples every ``interval`` s, asked for by ``key``, that miss the bands' frequencies."""
    nyquist = np.pi / pass_bands(cell)[-1].high
    if interval < nyquist:
        return []
    seen = "" if interval == value else f"an interval of {interval:.4g} s is "
    return [Problem(key, value, f"{seen}too coarse for the bands; the top band's Nyquist interval is {nyquist:.4g} s")]


def sites_of(lattice: LatticeTable, contacts: ContactsTable) -> list[int]:
    """Sites as 1-based cells."""
    sites = contacts.sites
    if isinstance(sites, Span) and sites.last is None:
        return [sites.first + (sites.spacing or 1) * i for i in range(sites.count)]
    if isinstance(sites, Span):
        return [c + 1 for c in spread_sites(sites.first, sites.last, sites.count)]
    if isinstance(sites, int):
        preset = PRESETS.get(str(lattice.preset))
        return [c + 1 for c in preset.sites(lattice.cells, sites)] if preset and sites else []
    return list(sites)
