"""Resolution of the choices of a case file into plain numbers: cell, sites, clearances, stiffness, frequency, times."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from vipetsc.case.absorbing import designed_end
from vipetsc.case.case_file import Valid
from vipetsc.case.contacts import (
    MATERIAL,
    check_per_site,
    gaps_of_sites,
    is_all_rigid,
    laws_of_sites,
    lists_of,
    pairs_of_sites,
    values_of_sites,
    with_stiffness,
)
from vipetsc.case.drive import DriveTable, build_drives, packet_speed, resolve_drives, waveform_of
from vipetsc.case.inhomogeneity import cell_variation
from vipetsc.case.initial import Beginning, InitialTable
from vipetsc.case.reading import Table
from vipetsc.case.schema import CONTACTS, PRESETS, DampingTable, LatticeTable, TimeTable
from vipetsc.case.section import Problem
from vipetsc.case.sites import ContactsTable, Span
from vipetsc.case.waveforms import DEFAULT, is_sine
from vipetsc.lattice import Chain, UnitCell, pass_bands, sites_at
from vipetsc.lattice.cell import cell_problems, connected_groups
from vipetsc.lattice.chain import unstable_key
from vipetsc.lattice.contact import RIGID

# A key of a case file takes the place of these keys of the preset, which would contradict it.
REPLACES = {
    "stiffness": {"modulus", "radius", "poisson"},
    "frequency": {"wavenumber", "band", "at"},
    "wavenumber": {"at"},
    "at": {"wavenumber"},
}
# Samples of half a period of the top band's edge where no interval is given; one would just resolve the bands.
SAMPLES_OF_HALF_PERIOD = 3
WHOLE = 1e-12  # fraction by which a number of intervals differs from a whole one by rounding


def with_default_preset(table: Table) -> Table:
    """Return ``table`` with the four-band preset unless it names another or a cell."""
    lattice = table.get("lattice", {})
    if not isinstance(lattice, dict) or "cell" in lattice:
        return table
    return table | {"lattice": {"preset": "four-band"} | lattice}


def with_preset(table: Table) -> Table:
    """Return ``table`` with the preset's length, contacts and drive where it does not give them itself.

    A lattice that begins in motion has no drive unless the table has a section for one.
    """
    table = with_default_preset(table)
    initial = table.get("initial", {})
    # Types are not checked yet: whatever is no table stays as it is, and is refused where sections are read.
    if isinstance(initial, dict) and initial.get("kind", "zero") != "zero" and "drive" not in table:
        table = table | {"drive": {"amplitude": 0.0}}

    lattice = table.get("lattice", {})
    if not isinstance(lattice, dict) or "cell" in lattice or str(lattice["preset"]) not in PRESETS:
        return table

    preset = PRESETS[str(lattice["preset"])]
    table = table | {"lattice": {"cells": preset.cells} | lattice}
    if isinstance(table.get("contacts", {}), dict):
        given = table.get("contacts", {})
        defaults = preset.contacts
        if given.get("law") == RIGID and "each" not in given:
            # A stop that does not yield has no material.
            defaults = {key: value for key, value in defaults.items() if key not in MATERIAL}
        table["contacts"] = _with_defaults(defaults, given)
    if isinstance(table.get("drive", {}), dict):
        drive = table.get("drive", {})
        table["drive"] = _with_defaults(_preset_drive(preset.drive, drive), drive)
    return table


def _preset_drive(defaults: Table, given: Table) -> Table:
    """Return the keys of a preset's drive that apply to a ``given`` one: the paper's burst, or its place on a band."""
    # Without an amplitude nothing is driven, and there is the motion at t = 0 alone.
    if given.get("amplitude") == 0:
        return {}
    waveform = given.get("waveform", DEFAULT)
    if waveform == DEFAULT:
        return defaults
    if is_sine(waveform):
        return {key: value for key, value in defaults.items() if key in REPLACES["frequency"]}
    return {}


def _with_defaults(defaults: Table, given: Table) -> Table:
    """Return ``given`` with the ``defaults`` that none of its keys replaces."""
    # For instance, a stiffness replaces the preset's material, and a frequency its wavenumber.
    replaced = {key for choice in given.keys() & REPLACES.keys() for key in REPLACES[choice]}
    return {key: value for key, value in defaults.items() if key not in replaced} | given


def site_cells(lattice: LatticeTable, contacts: ContactsTable) -> list[int]:
    """Return the cells (1-based) with a contact; [] for a count without a preset to place it."""
    sites = contacts.sites
    if isinstance(sites, list):
        return sites
    if isinstance(sites, int):
        preset = PRESETS.get(str(lattice.preset))
        if preset is None or sites == 0:
            return []
        first, last = preset.site_span(lattice.cells, sites)
        return _spread(first, last, sites)
    if sites.last is None:
        return [sites.first + (sites.spacing or 1) * i for i in range(sites.count)]
    return _spread(sites.first, sites.last, sites.count)


def cells_of_sites(lattice: LatticeTable, contacts: ContactsTable) -> list[tuple[int, ...]]:
    """Return the cells (1-based) whose masses each site joins: its own one, and the next one if it reaches there."""
    cells = site_cells(lattice, contacts)
    joined: list[tuple[int, ...]] = [(cell,) for cell in cells]
    # A list over the sites may have another length, which ``check_per_site`` reports.
    for site, reaches_on in enumerate(values_of_sites(contacts, "next_cell", len(cells))[: len(cells)]):
        if reaches_on:
            # The first cell of a ring follows the last one.
            joined[site] += (cells[site] % lattice.cells + 1,)
    return joined


def _spread(first: float, last: float, count: int) -> list[int]:
    """Return ``count`` whole numbers evenly from ``first`` to ``last``."""
    return [int(cell) for cell in np.round(np.linspace(first, last, count))]


def clearances(lattice: LatticeTable, contacts: ContactsTable, count: int) -> list[float]:
    """Return clearances in m of ``count`` sites, log-spaced over a span; the preset's where none are given."""
    given = contacts.clearance
    if isinstance(given, list):
        return given
    if isinstance(given, float):
        return [given] * count
    if given is None and count == 0:
        return []
    if given is None:
        first, last = PRESETS[str(lattice.preset)].clearance_span(count)
    else:
        first = given.first
        last = given.last
    return [float(clearance) for clearance in np.geomspace(first, last, count)]


def build_chain(lattice: LatticeTable, contacts: ContactsTable) -> Chain:
    """Return the lattice with its contact sites."""
    cell = lattice.unit_cell()
    cells = site_cells(lattice, contacts)
    given = clearances(lattice, contacts, len(cells))
    sites = sites_at(
        np.array(cells, int) - 1,
        pairs_of_sites(contacts, cell, len(cells)),
        laws_of_sites(contacts, len(cells)),
        clearances=given,
        gaps=gaps_of_sites(contacts, given),
    )
    return Chain(cell, lattice.cells, lattice.ends, sites=sites, variation=cell_variation(lattice))


def check_cell(lattice: LatticeTable) -> tuple[UnitCell | None, list[Problem]]:
    """Return the unit cell, or what is wrong with it."""
    problems = []
    if lattice.preset is not None and lattice.cell is not None:
        problems.append(Problem("lattice.preset", lattice.preset, "give a preset or [lattice.cell], not both"))
    for key, value in (("lattice.lambda", lattice.lam), ("lattice.eta", lattice.eta)):
        if value is not None and lattice.preset != "four-band":
            problems.append(Problem(key, value, "only the four-band preset has it"))
    if lattice.cell:
        wrong = cell_problems(*lattice.cell.arguments())
        problems += [Problem(f"lattice.cell.{key}", None, message) for key, message in wrong]
    if lattice.damping and not problems:
        problems += _check_damping(lattice.damping, lattice.undamped_cell())
    if problems:
        return None, problems

    cell = lattice.unit_cell()
    problems += _check_stability(lattice, cell)
    if problems:
        return None, problems
    # The section of contacts decides about cells that contacts join: see ``check_pairs``.
    if not cell.joins_cells:
        return cell, problems

    # Node 0 stands for the next cell: what is not joined to it belongs to no chain.
    to_next_cell = [(0, spring.start + 1) for spring in cell.springs if spring.offset]
    within = [(spring.start + 1, spring.end + 1) for spring in cell.springs]
    group = connected_groups(cell.dofs + 1, (*to_next_cell, *within))
    loose = [str(mass) for mass, number in enumerate(group) if number != group[0]]
    if loose:
        what = f"mass {', '.join(loose)} is not connected to the next cell"
        # The physics allows it, but measures and drives count bands from the lowest frequency on.
        why = "not yet, by contacts alone: between impacts it flies freely, which would be a flat band at frequency 0"
        remedy = "add springs, or a spring with next_cell; a soft one leaves the flights nearly free"
        problems.append(Problem("lattice.cell.springs", None, f"{what} ({why}): {remedy}"))
    return cell, problems


def _check_stability(lattice: LatticeTable, cell: UnitCell) -> Iterator[Problem]:
    """Yield problems with negative springs and dashpots of a ``cell``, and with ends that its matrices do not have."""
    of_matrices = lattice.cell is not None and lattice.cell.from_matrices is not None
    if of_matrices and lattice.ends == "free" and cell.is_grounded:
        # Cut springs leave the ground springs by which a bent or a turned structure is not strained.
        remedy = 'the matrices pull to the ground, as those with rotations do: use "fixed" or "periodic"'
        yield Problem("lattice.ends", "free", remedy)
        return
    key = unstable_key(cell, lattice.ends, lattice.cells)
    if key is None:
        return
    remedy = "is negative, and other springs and dashpots do not outweigh it: the lattice is unstable at rest"
    if of_matrices:
        matrix = "K" if key.endswith("stiffness") else "C"
        key = "matrices"
        remedy = f"{matrix} is not positive semidefinite in the lattice; write all digits, and check signs and boundary"
    yield Problem(f"lattice.cell.{key}", None, remedy)


def _check_damping(damping: DampingTable, cell: UnitCell) -> Iterator[Problem]:
    """Yield problems with the loss of bands, or with dashpots that are given in its place."""
    loss = damping.loss
    bands = {str(number) for number in range(1, cell.dofs + 1)}
    fitted = (damping.grounding, damping.springs)
    expected = [cell.dofs, len(cell.springs)]
    if loss is not None and not cell.joins_cells:
        remedy = "without springs from cell to cell there are no bands; give mass and stiffness"
        yield Problem("lattice.damping.loss", loss, remedy)
    elif loss is not None and (not loss or loss.keys() - bands):
        remedy = f"give it by band, 1 to {cell.dofs}, as in loss = {{ 2 = 0.02 }}"
        yield Problem("lattice.damping.loss", loss, remedy)
    elif loss is not None and (damping.mass or damping.stiffness):
        yield Problem("lattice.damping.loss", loss, "give it, or mass and stiffness, not both")
    elif fitted != (None, None) and (loss is None or [len(values or ()) for values in fitted] != expected):
        yield Problem("lattice.damping.grounding", fitted[0], "grounding and springs are fitted to loss; remove both")


def check_sites(lattice: LatticeTable, contacts: ContactsTable) -> Iterator[Problem]:
    """Yield problems with the cells of the contacts and with their clearances."""
    sites = contacts.sites
    clearance = contacts.clearance
    count = 0
    if isinstance(sites, int):
        count = sites
    elif isinstance(sites, Span):
        count = sites.count
    # Checked before the sites are placed, since a count may exceed the memory.
    if count > lattice.cells:
        yield Problem("contacts.sites", count, f"more sites than the lattice has cells, {lattice.cells}")
        return

    cells = site_cells(lattice, contacts)
    outside = [cell for cell in cells if not 1 <= cell <= lattice.cells]
    if outside:
        yield Problem("contacts.sites", outside, f"outside the lattice; cells are numbered from 1 to {lattice.cells}")
    if isinstance(sites, Span) and None not in (sites.last, sites.spacing):
        yield Problem("contacts.sites.spacing", None, "give last or spacing, not both")
    has_pair = contacts.pair is not None or (contacts.each is not None and contacts.each.pair is not None)
    twice = sorted(cell for cell, times in Counter(cells).items() if times > 1)
    if twice and not has_pair:
        yield Problem("contacts.sites", twice, "given twice; a cell has one contact pair")
    if isinstance(sites, int) and sites > 0 and lattice.preset is None:
        yield Problem("contacts.sites", sites, "a count needs a preset; list the cells or give {first, last, count}")

    if isinstance(clearance, list) and len(clearance) != len(cells):
        yield Problem("contacts.clearance", clearance, f"give one clearance for each of the {len(cells)} sites")
    if clearance is None and lattice.preset is None and cells:
        yield Problem("contacts.clearance", None, "missing; give the clearance in m")


def check_contacts(
    lattice: LatticeTable, contacts: ContactsTable, initial: InitialTable | None, valid: Valid
) -> Iterator[Problem]:
    """Yield problems with the sites of a run that begins with the motion ``initial``, and with the law."""
    yield from check_sites(lattice, contacts)
    # A count of sites has no cells where no preset places them.
    sites = site_cells(lattice, contacts)
    is_unplaced = isinstance(contacts.sites, int) and lattice.preset is None
    yield from check_stiffness(contacts, bool(contacts.sites) and not is_unplaced, valid)

    gaps: list[float] = []
    if contacts.clearance is not None or lattice.preset is not None:
        gaps = clearances(lattice, contacts, len(sites))
    if len(gaps) == len(sites):
        ring = lattice.cells if lattice.ends == "periodic" else None
        joined = cells_of_sites(lattice, contacts)
        at_rest = [initial is None or all(initial.is_at_rest(cell, ring) for cell in cells) for cells in joined]
        yield from check_per_site(contacts, gaps, at_rest, valid)


def check_stiffness(contacts: ContactsTable, any_sites: bool, valid: Valid) -> Iterator[Problem]:
    """Yield problems with a stiffness that is missing where there are ``any_sites``, or given twice.

    It is a number, or follows from the material. A radius may stand beside the number: indentations are compared to it.
    """
    given = [key for key in MATERIAL if getattr(contacts, key) is not None]
    missing = [key for key in MATERIAL if key not in given]
    if contacts.stiffness is not None and given not in ([], ["radius"]):
        yield Problem("contacts.stiffness", contacts.stiffness, f"give it or {', '.join(given)}, not both")
    # A material that is given for each site in part is completed by that of all sites, as ``check_per_site`` says.
    has_stiffnesses = bool(lists_of(contacts).keys() & {"stiffness", *MATERIAL})
    is_needed = any_sites and contacts.stiffness is None and not has_stiffnesses and not is_all_rigid(contacts)
    if is_needed and missing and valid(*(f"contacts.{key}" for key in MATERIAL)):
        yield Problem("contacts.stiffness", None, f"missing; give it or also {', '.join(missing)}")


def resolve(sections: Mapping[str, Any], beginning: Beginning | None) -> dict[str, Any]:
    """Return the ``sections`` of a valid lattice run in which every choice is resolved, and its initial motion.

    Raises ValueError if no absorbing end satisfies the bound.
    """
    lattice = sections["lattice"]
    cell = lattice.unit_cell()
    drive = _resolved_drive(sections["drive"], cell, lattice.cells, beginning)
    initial = _resolved_initial(beginning, drive)
    reference = reference_drive(drive, initial)

    resolved = dict(sections)
    resolved["lattice"] = _resolved_lattice(lattice, cell, reference)
    resolved["contacts"] = resolved_contacts(sections["contacts"], lattice)
    resolved["drive"] = drive
    resolved["time"] = _resolved_time(sections["time"], cell, lattice.cells, reference)
    # The case of a lattice at rest is the same with a section [initial] and without.
    resolved.pop("initial", None)
    if initial:
        resolved["initial"] = initial
    return resolved


def _resolved_drive(drive: DriveTable, cell: UnitCell, cells: int, beginning: Beginning | None) -> DriveTable:
    """Return drives; where nothing is driven they have no frequency, and by default the cell of the motion at t = 0."""
    if beginning is None or drive.amplitude != 0:
        return resolve_drives(drive, cell, cells)
    resolved = resolve_drives(drive, cell, cells, beginning.frequency).model_copy(update={"frequency": None})
    if "cell" in drive.model_fields_set:
        return resolved
    return resolved.model_copy(update={"cell": beginning.cell})


def _resolved_initial(beginning: Beginning | None, drive: DriveTable) -> InitialTable | None:
    """Return the motion at t = 0, with its frequency where nothing is driven; None for a lattice at rest."""
    if beginning is None:
        return None
    frequency = None
    if drive.amplitude == 0:
        frequency = beginning.frequency
    return beginning.section.model_copy(update={"frequency": frequency})


def reference_drive(drive: DriveTable, initial: InitialTable | None) -> DriveTable:
    """Return the drives to which times and tolerances refer; if nothing is driven, with the frequency at t = 0."""
    if drive.frequency is None and initial is not None:
        return drive.model_copy(update={"frequency": initial.frequency})
    return drive


def contact_frequency(lattice: LatticeTable, contacts: ContactsTable, speed: float) -> float | None:
    """Return the frequency in rad/s whose half period the shortest contact at a ``speed`` in m/s is, or None."""
    resolved = resolved_contacts(contacts, lattice)
    chain = build_chain(lattice, resolved)
    return max((np.pi / time for time in chain.impact_times(speed)), default=None)


def _resolved_lattice(lattice: LatticeTable, cell: UnitCell, drive: DriveTable) -> LatticeTable:
    """Return the lattice with an absorbing end that suits the ``drive``, and with fitted dashpots."""
    update: dict[str, Any] = {}
    # An end whose cells and strength are both given is taken as it is, whatever it reflects.
    absorbing = lattice.absorbing
    if absorbing and not (absorbing.cells and absorbing.strength):
        drives = build_drives(drive, Chain(cell, lattice.cells, lattice.ends))
        update["absorbing"] = designed_end(absorbing, cell, lattice.ends, drives, lattice.cells)

    damping = lattice.damping
    if damping and damping.loss:
        grounding, springs = damping.fitted(lattice.undamped_cell())
        fitted = {"grounding": grounding.tolist(), "springs": springs.tolist()}
        update["damping"] = damping.model_copy(update=fitted)
    return lattice.model_copy(update=update)


def resolved_contacts(contacts: ContactsTable, lattice: LatticeTable) -> ContactsTable:
    """Return the contacts with a cell and a clearance for every site, and a stiffness in place of a material."""
    sites = site_cells(lattice, contacts)
    resolved = with_stiffness(contacts, len(sites))
    update: dict[str, Any] = {"sites": sites, "clearance": clearances(lattice, contacts, len(sites))}
    if contacts.damping == "paper":
        update["damping"] = None  # as if left out: the same case
    is_of_material = resolved.modulus is None and contacts.modulus is not None
    if is_of_material and lattice.preset and contacts.radius == CONTACTS["radius"]:
        update["radius"] = None  # the preset says it
    return resolved.model_copy(update=update)


def _resolved_time(time: TimeTable, cell: UnitCell, cells: int, drive: DriveTable) -> TimeTable:
    """Return the end and the sample interval in s of a lattice of ``cells`` cells under a resolved ``drive``.

    The end is a whole number of intervals: a last interval that is shorter would spoil every spectrum. An end in s is
    kept, and the interval shortened; the end that follows from the wave is moved to the sample before it. Samples that
    are counted by the period of the drive end with a period.
    """
    end = time.end
    if end == "traverse":
        # Until the last drive is over, and the wave of the first has crossed the lattice.
        settled = max(waveform_of(one).settled for _, one in drive.every)
        end = settled + cells / packet_speed(cell, drive)

    interval = time.sample_interval
    if time.samples_per_period is not None:
        # The drive is resolved, and has a frequency.
        assert drive.frequency
        period = 2 * np.pi / drive.frequency
        interval = period / time.samples_per_period
        end = max(int(end / period * (1 + WHOLE)), 1) * period
    elif time.samples is not None:
        # The first sample is at t = 0 and the last at the end.
        interval = end / (time.samples - 1)
    elif interval == "auto":
        interval = _round_down(np.pi / (SAMPLES_OF_HALF_PERIOD * pass_bands(cell)[-1].high))

    count = end / interval
    # A resolved case is resolved again when it is read: a number of intervals that is whole to rounding stays.
    if abs(count - round(count)) > WHOLE * count:
        if time.end == "traverse":
            end = max(int(count), 1) * interval
        else:
            interval = end / int(np.ceil(count))
    numbers = {"end": float(end), "sample_interval": float(interval)}
    return time.model_copy(update=numbers | dict.fromkeys(("samples", "samples_per_period")))


def _round_down(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above ``value``."""
    decade = int(np.floor(np.log10(value)))
    lead = max(m for m in (1, 2, 5) if m * 10.0**decade <= value)
    # Read from text: 5 * 10.0**-6 is not the double nearest to 5e-6.
    return float(f"{lead}e{decade}")
