"""From the choices of a case file to plain numbers: sites, clearances, stiffness, frequency, times."""

from typing import Any

import numpy as np

from vipetsc.case.reading import Table
from vipetsc.case.schema import ClearanceSpan, ContactsTable, DriveTable, LatticeTable, TimeTable
from vipetsc.lattice import bloch, max_group_velocity, pass_bands, waves_at
from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import log_clearances, spread_sites
from vipetsc.lattice.contact import contact_stiffness
from vipetsc.lattice.presets import PRESETS

# A key of a case file takes the place of these keys of the preset.
REPLACES = {
    "stiffness": {"modulus", "radius", "poisson"},
    "frequency": {"wavenumber", "band", "at"},
    "wavenumber": {"at"},
    "at": {"wavenumber"},
}


def with_default_preset(table: Table) -> Table:
    """``table`` with the four-band preset unless it names another or a cell."""
    lattice = table.get("lattice", {})
    if not isinstance(lattice, dict) or "cell" in lattice:
        return table
    return table | {"lattice": {"preset": "four-band"} | lattice}


def with_preset(table: Table) -> Table:
    """``table`` with the preset's length, contacts and drive where it does not give them itself."""
    table = with_default_preset(table)
    lattice = table.get("lattice", {})
    if not isinstance(lattice, dict) or "cell" in lattice or str(lattice["preset"]) not in PRESETS:
        return table
    preset = PRESETS[str(lattice["preset"])]
    table = table | {"lattice": {"cells": preset.cells} | lattice}
    for name, defaults in (("contacts", preset.contacts), ("drive", preset.drive)):
        given = table.get(name, {})
        if isinstance(given, dict):
            replaced = {key for choice in given.keys() & REPLACES.keys() for key in REPLACES[choice]}
            table[name] = {k: v for k, v in defaults.items() if k not in replaced} | given
    return table


def site_cells(lattice: LatticeTable, contacts: ContactsTable) -> list[int]:
    """The cells (1-based) with a contact; [] for a count without a preset to place it."""
    sites, preset = contacts.sites, PRESETS.get(str(lattice.preset))
    if isinstance(sites, list):
        return sites
    if isinstance(sites, int):
        if preset is None or sites == 0:
            return []
        first, last, count = *preset.site_span(lattice.cells, sites), sites
    elif sites.last is None:
        return [sites.first + (sites.spacing or 1) * i for i in range(sites.count)]
    else:
        first, last, count = sites.first, sites.last, sites.count
    return [c + 1 for c in spread_sites(first, last, count)]


def clearances(lattice: LatticeTable, contacts: ContactsTable, count: int) -> list[float]:
    """Clearances in m of ``count`` sites; the preset's where none are given."""
    given = contacts.clearance
    if given is None:
        return list(PRESETS[str(lattice.preset)].clearances(count)) if count else []
    if isinstance(given, ClearanceSpan):
        return list(log_clearances(given.first, given.last, count))
    return [given] * count if isinstance(given, float) else list(given)


def resolved(sections: dict[str, Any]) -> dict[str, Table]:
    """The sections of a valid lattice run as tables in which every choice is made."""
    tables = {name: section.model_dump(by_alias=True, exclude_none=True) for name, section in sections.items()}
    lattice, cell = sections["lattice"], sections["lattice"].unit_cell()
    tables["contacts"] = _resolved_contacts(tables["contacts"], lattice, sections["contacts"])
    frequency = _frequency(cell, sections["drive"])
    for key in ("wavenumber", "band", "at"):
        tables["drive"].pop(key, None)
    tables["drive"]["frequency"] = frequency
    cycles = sections["drive"].cycles
    tables["time"] |= _resolved_time(cell, lattice.cells, frequency, cycles, sections["time"])
    tables["time"].pop("samples", None)
    return tables


def _resolved_contacts(table: Table, lattice: LatticeTable, contacts: ContactsTable) -> Table:
    """Sites and clearances listed, the stiffness as a number."""
    sites = site_cells(lattice, contacts)
    table = table | {"sites": sites, "clearance": clearances(lattice, contacts, len(sites))}
    modulus, radius, poisson = contacts.modulus, contacts.radius, contacts.poisson
    if modulus is None or radius is None or poisson is None or contacts.stiffness is not None:
        return table
    table = {key: value for key, value in table.items() if key not in ("modulus", "radius", "poisson")}
    return table | {"stiffness": float(contact_stiffness(modulus, radius, poisson))}


def _frequency(cell: UnitCell, drive: DriveTable) -> float:
    """The drive's frequency in rad/s."""
    if drive.wavenumber is not None and drive.band is not None:
        return float(bloch(cell, drive.wavenumber).frequency[drive.band - 1])
    if drive.at is not None and drive.band is not None:
        return max_group_velocity(cell, drive.band)[1]
    assert drive.frequency is not None
    return drive.frequency


def _resolved_time(cell: UnitCell, cells: int, frequency: float, cycles: int, time: TimeTable) -> dict[str, float]:
    """End and sample interval in s."""
    end, interval = time.end, time.sample_interval
    if end == "traverse":
        end = 2 * np.pi * cycles / frequency + cells / wave_speed(cell, frequency)
    if time.samples is not None:
        interval = end / (time.samples - 1)
    elif interval == "auto":
        interval = _round_down(np.pi / (3 * pass_bands(cell)[-1].high))
    return {"sample_interval": float(interval), "end": float(end)}


def wave_speed(cell: UnitCell, frequency: float) -> float:
    """Group velocity in cells/s of the fastest wave at ``frequency``; in a gap, the cell's fastest."""
    speed = max((wave[2] for wave in waves_at(cell, frequency)), default=0.0)
    return speed or max(max_group_velocity(cell, band + 1)[2] for band in range(cell.dofs))


def _round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above ``value``."""
    decade = int(np.floor(np.log10(value)))
    lead = max(m for m in (1, 2, 5) if m * 10.0**decade <= value)
    return float(f"{lead}e{decade}")
