"""From the choices of a case file to plain numbers: presets, cell, sites, clearances, stiffness, frequency, times."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from vipetsc.case.case_file import Problem, Table, Valid
from vipetsc.case.contacts import check_per_site, pairs_of_sites, resolved_per_site
from vipetsc.case.drive import CYCLES, SINES, DriveTable, drive_tables, packet_speed, resolved_drive, waveform_of
from vipetsc.case.inhomogeneity import cell_variation, designed_end
from vipetsc.case.initial import Beginning
from vipetsc.case.schema import CONTACTS, PRESETS, DampingTable, LatticeTable, TimeTable
from vipetsc.case.sites import ContactsTable, Span
from vipetsc.lattice import Chain, UnitCell, contact_stiffness, pass_bands
from vipetsc.lattice.cell import cell_problems, connected_groups

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
    """``table`` with the preset's length, contacts and drive where it does not give them itself.

    With an initial state, and no section for a drive, there is none.
    """
    table, initial = with_default_preset(table), table.get("initial", {})
    if isinstance(initial, dict) and initial.get("kind", "zero") != "zero" and "drive" not in table:
        table = table | {"drive": {"amplitude": 0.0}}
    lattice = table.get("lattice", {})
    if not isinstance(lattice, dict) or "cell" in lattice or str(lattice["preset"]) not in PRESETS:
        return table
    preset = PRESETS[str(lattice["preset"])]
    table = table | {"lattice": {"cells": preset.cells} | lattice}
    for name, defaults in (("contacts", preset.contacts), ("drive", preset.drive)):
        given = table.get(name, {})
        if isinstance(given, dict):
            if given.get("amplitude") == 0:
                defaults = {}  # of an initial state alone
            if given.get("waveform", "burst") != "burst":  # of the paper's burst, but for where its wave is
                waves = REPLACES["frequency"] if given["waveform"] in SINES else ()
                defaults = {key: value for key, value in defaults.items() if key in waves}
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
    return [int(cell) for cell in np.round(np.linspace(first, last, count))]


def clearances(lattice: LatticeTable, contacts: ContactsTable, count: int) -> list[float]:
    """Clearances in m of ``count`` sites, log-spaced over a span; the preset's where none are given."""
    given = contacts.clearance
    if isinstance(given, list):
        return given
    if isinstance(given, float):
        return [given] * count
    if given is None and count == 0:
        return []
    first, last = (given.first, given.last) if given else PRESETS[str(lattice.preset)].clearance_span(count)
    return [float(clearance) for clearance in np.geomspace(first, last, count)]


def build_chain(lattice: LatticeTable, contacts: ContactsTable) -> Chain:
    """The lattice with its contact sites."""
    sites = site_cells(lattice, contacts)
    gaps = clearances(lattice, contacts, len(sites))
    cell, places = lattice.unit_cell(), tuple(c - 1 for c in sites)
    pairs = pairs_of_sites(contacts.model_copy(update={"sites": sites}), cell, len(sites))
    return Chain(cell, lattice.cells, lattice.ends, places, tuple(gaps), cell_variation(lattice), pairs)


def check_cell(lattice: LatticeTable) -> tuple[UnitCell | None, list[Problem]]:
    """The unit cell, or what is wrong with it."""
    problems = []
    if lattice.preset is not None and lattice.cell is not None:
        problems.append(Problem("lattice.preset", lattice.preset, "give a preset or [lattice.cell], not both"))
    for key, value in (("lattice.lambda", lattice.lam), ("lattice.eta", lattice.eta)):
        if value is not None and lattice.preset != "four-band":
            problems.append(Problem(key, value, "only the four-band preset has it"))
    wrong = cell_problems(*lattice.cell.arguments()) if lattice.cell else []
    problems += [Problem(f"lattice.cell.{key}", None, message) for key, message in wrong]
    problems += [] if problems or lattice.damping is None else _check_damping(lattice.damping, lattice.undamped_cell())
    if problems:
        return None, problems
    cell = lattice.unit_cell()
    if not cell.springs:
        return cell, problems
    next_cell = tuple((0, s.start + 1) for s in cell.springs if s.next_cell)
    group = connected_groups(cell.dofs + 1, (*next_cell, *((s.start + 1, s.end + 1) for s in cell.springs)))
    if loose := [str(mass) for mass, number in enumerate(group) if number != group[0]]:
        remedy = f"nothing ties mass {', '.join(loose)} to the next cell: add springs, or a spring with next_cell"
        problems.append(Problem("lattice.cell.springs", None, remedy))
    return cell, problems


def _check_damping(damping: DampingTable, cell: UnitCell) -> Iterator[Problem]:
    """What is wrong with the loss of bands, or with dashpots that are given in its place."""
    loss, fitted, bands = damping.loss, (damping.grounding, damping.springs), [str(i + 1) for i in range(cell.dofs)]
    if loss is not None and (not loss or loss.keys() - {*bands} or not cell.springs):
        remedy = "a cell without springs has no bands" if not cell.springs else f"give it by band, 1 to {cell.dofs}"
        yield Problem("lattice.damping.loss", loss, f"{remedy}, as in loss = {{ 2 = 0.02 }}")
    elif loss is not None and (damping.mass or damping.stiffness):
        yield Problem("lattice.damping.loss", loss, "give it, or mass and stiffness, not both")
    elif fitted != (None, None) and (loss is None or [len(f or ()) for f in fitted] != [cell.dofs, len(cell.springs)]):
        yield Problem("lattice.damping.grounding", fitted[0], "it and springs are fitted to loss; leave them out")


def check_sites(lattice: LatticeTable, contacts: ContactsTable) -> Iterator[Problem]:
    """What is wrong with where the contacts are, and with their clearances."""
    sites, clearance = contacts.sites, contacts.clearance
    count = sites.count if isinstance(sites, Span) else sites if isinstance(sites, int) else 0
    if count > lattice.cells:
        yield Problem("contacts.sites", count, f"more sites than the lattice has cells, {lattice.cells}")
        return
    cells = site_cells(lattice, contacts)
    if outside := [c for c in cells if not 1 <= c <= lattice.cells]:
        yield Problem("contacts.sites", outside, f"outside the lattice; cells count from 1 to {lattice.cells}")
    if isinstance(sites, Span) and None not in (sites.last, sites.spacing):
        yield Problem("contacts.sites.spacing", None, "give last or spacing, not both")
    plain = contacts.pair is None and (contacts.each is None or contacts.each.pair is None)
    if plain and (twice := sorted(cell for cell, times in Counter(cells).items() if times > 1)):
        yield Problem("contacts.sites", twice, "named twice; a cell carries one contact pair")
    if isinstance(sites, int) and sites > 0 and lattice.preset is None:
        yield Problem("contacts.sites", sites, "a count needs a preset; list the cells or give {first, last, count}")
    if isinstance(clearance, list) and len(clearance) != len(cells):
        yield Problem("contacts.clearance", clearance, f"one clearance for each of the {len(cells)} sites is needed")
    if clearance is None and lattice.preset is None and cells:
        yield Problem("contacts.clearance", None, "missing; give the clearance in m")


def check_contacts(lattice: LatticeTable, contacts: ContactsTable, valid: Valid) -> Iterator[Problem]:
    """What is wrong with the sites of a run and with the law."""
    yield from check_sites(lattice, contacts)
    counted = isinstance(contacts.sites, int) and lattice.preset is None  # which needs a preset to place them
    given = contacts.each and (contacts.each.stiffness or contacts.each.modulus)
    yield from check_stiffness(contacts, bool(contacts.sites) and not counted and not given, valid)
    sites = [] if counted else site_cells(lattice, contacts)
    placed = contacts.clearance is not None or lattice.preset is not None or not sites
    gaps = clearances(lattice, contacts, len(sites)) if placed else []
    if len(gaps) == len(sites):
        yield from check_per_site(contacts, len(sites), gaps, valid)


def check_stiffness(contacts: ContactsTable, any_sites: bool, valid: Valid) -> Iterator[Problem]:
    """The contact stiffness is given once: as a number, or by the material; a radius may stand beside the number."""
    material = {"modulus": contacts.modulus, "radius": contacts.radius, "poisson": contacts.poisson}
    given = [key for key, value in material.items() if value is not None]
    missing = [key for key in material if key not in given]
    if contacts.stiffness is not None and given not in ([], ["radius"]):
        yield Problem("contacts.stiffness", contacts.stiffness, f"give it or {', '.join(given)}, not both")
    if contacts.stiffness is None and missing and any_sites and valid(*(f"contacts.{key}" for key in material)):
        yield Problem("contacts.stiffness", None, f"missing; give it or also {', '.join(missing)}")


def resolved(sections: dict[str, Any], beginning: Beginning | None) -> dict[str, Table]:
    """The sections of a valid lattice run as tables in which every choice is made, and how it begins."""
    tables = {name: section.model_dump(by_alias=True, exclude_none=True) for name, section in sections.items()}
    lattice, contacts, drive, time = (sections[name] for name in ("lattice", "contacts", "drive", "time"))
    cell, sites, law = lattice.unit_cell(), site_cells(lattice, contacts), tables["contacts"]
    if contacts.damping == "paper":
        del law["damping"]  # as if left out: the same case
    law |= {"sites": sites, "clearance": clearances(lattice, contacts, len(sites))}
    if each := resolved_per_site(contacts, len(sites)):
        law["each"] = each
    if contacts.stiffness is None and law.keys() >= REPLACES["stiffness"]:
        law["stiffness"] = float(contact_stiffness(law.pop("modulus"), law["radius"], law.pop("poisson")))
        if lattice.preset and law["radius"] == CONTACTS["radius"]:
            del law["radius"]  # it goes without saying
    told = beginning if beginning and drive.amplitude == 0 else None
    tables["drive"] = resolved_drive(drive, cell, lattice.cells, told.frequency if told else None)
    if drive.more:
        tables["drive"]["more"] = [resolved_drive(more, cell, lattice.cells) for more in drive.more]
    end, interval = time.end, time.sample_interval
    if end == "traverse":
        told_drive = DriveTable(**tables["drive"])
        end = max(waveform_of(one).settled for _, one in told_drive.every)
        end += lattice.cells / packet_speed(cell, told_drive)
    if time.samples is not None:
        interval = end / (time.samples - 1)
    elif interval == "auto":
        interval = _round_down(np.pi / (3 * pass_bands(cell)[-1].high))
    if (absorbing := lattice.absorbing) and not (absorbing.cells and absorbing.strength):
        sent = tuple((one["frequency"], one.get("cycles", CYCLES)) for one in drive_tables(tables["drive"]))
        designed = designed_end(absorbing, cell, lattice.ends, sent, lattice.cells // 3)
        tables["lattice"]["absorbing"] = designed.model_dump()
    if (damping := lattice.damping) and damping.loss:
        fitted = (values.tolist() for values in damping.fitted(lattice.undamped_cell()))
        tables["lattice"]["damping"] |= dict(zip(("grounding", "springs"), fitted, strict=True))
    tables.pop("initial", None)
    tables |= {"initial": beginning.table} if beginning else {}
    if told and "cell" not in drive.model_fields_set:
        tables["drive"]["cell"] = told.cell
    tables["time"] |= {"sample_interval": float(interval), "end": float(end)}
    tables["time"].pop("samples", None)
    return tables


def check_unsprung(drive: DriveTable, time: TimeTable) -> Iterator[Problem]:
    """A lattice that contacts alone join has no bands from which times could follow."""
    remedy = "missing; without springs there are no bands that it follows from"
    if drive.frequency is None:
        yield Problem("drive.frequency", None, remedy)
    if time.end == "traverse":
        yield Problem("time.end", time.end, remedy)
    if time.sample_interval == "auto" and time.samples is None:
        yield Problem("time.sample_interval", time.sample_interval, remedy)


def _round_down(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above ``value``."""
    decade = int(np.floor(np.log10(value)))
    lead = max(m for m in (1, 2, 5) if m * 10.0**decade <= value)
    return float(f"{lead}e{decade}")
