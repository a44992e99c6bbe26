"""Problems between the keys of a case of normal modes."""

from collections.abc import Iterator

from vipetsc.case.bodies import bodies_of, check_apart, contact_ends
from vipetsc.case.case_file import Valid
from vipetsc.case.contacts import (
    Gaps,
    check_joined,
    check_pairs,
    has_equal_sides,
    is_rigid_of_sites,
    lists_of,
    pairs_of_sites,
    path_of,
    values_of_sites,
)
from vipetsc.case.inhomogeneity import check_inhomogeneity
from vipetsc.case.nfrc import MOST_UNKNOWNS, needs_modes
from vipetsc.case.nnm.table import MOST_MASSES, MOST_OF_DAMPED, NnmTable
from vipetsc.case.resolve import build_chain, check_stiffness, site_cells
from vipetsc.case.schema import LatticeTable
from vipetsc.case.section import Problem
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import Chain, UnitCell, nonlinear_springs, wave_bands
from vipetsc.lattice.cell import connected_groups
from vipetsc.lattice.compliance.by_modes import MOST_DOFS

ONE_CONTACT = "the reduced model has one contact"


def check_options(nnm: NnmTable) -> Iterator[Problem]:
    """Yield problems with a user-defined system, and with the bounds of a branch and its steps."""
    if (nnm.system == "own") != (nnm.custom is not None):
        yield Problem("nnm.system", nnm.system, 'a system of one\'s own needs "own" and [nnm.own]')
    # On the way down the energy may tend to 0, which no number of steps in its logarithm reaches.
    if nnm.direction != "up" and not nnm.energy[0] > 0:
        yield Problem("nnm.energy", nnm.energy, "the direction down needs a lowest energy above 0 (J)")

    yield from check_method(nnm)
    if not nnm.smallest_step < nnm.largest_step:
        yield Problem("nnm.smallest_step", nnm.smallest_step, "must be below nnm.largest_step")
    if nnm.system != "own" or nnm.custom is None:
        return

    masses = len(nnm.custom.masses)
    pairs = [(f"springs[{i}]", s.start, s.end) for i, s in enumerate(nnm.custom.springs, 1)]
    pairs += [(f"smooth[{i}]", s.start, s.end) for i, s in enumerate(nnm.custom.smooth, 1)]
    pairs += [(f"dashpots[{i}]", d.start, d.end) for i, d in enumerate(nnm.custom.dashpots, 1)]
    pairs += [(f"contacts[{i}]", p.host, p.resonator) for i, p in enumerate(nnm.custom.contacts, 1)]
    for key, start, end in pairs:
        if start == end or max(start, end) > masses:
            yield Problem(f"nnm.own.{key}", [start, end], f"is not a pair of the {masses} masses (0 is the ground)")


def check_rigid_stops(nnm: NnmTable, contacts: ContactsTable) -> Iterator[Problem]:
    """Yield problems with rigid stops, which only orbits that are shot may have, without loss."""
    count = max((len(values) for values in lists_of(contacts).values()), default=1)
    is_rigid = is_rigid_of_sites(contacts, count)
    if not any(is_rigid):
        return
    if nnm.system == "condensed" or nnm.method != "shooting":
        key = "nnm.system" if nnm.system == "condensed" else "nnm.method"
        remedy = 'the harmonics of an impulse do not decay; use method = "shooting" and a system of all masses'
        yield Problem(key, getattr(nnm, key.removeprefix("nnm.")), f"{remedy}, or a law that yields")
    restitutions = values_of_sites(contacts, "restitution", count)
    lossy = [r for r, rigid in zip(restitutions, is_rigid, strict=True) if rigid and r < 1]
    if lossy:
        remedy = "a rigid stop takes a part of the energy at each impact, so that no free motion repeats itself"
        yield Problem(path_of(contacts, "restitution"), lossy[0], f"{remedy}; set it to 1")
    if nnm.chart != "relative":
        yield Problem("nnm.chart", nnm.chart, "orbits do not begin on a rigid stop; remove it")


def check_forced(nnm: NnmTable, cells: int | None, masses: int) -> Iterator[Problem]:
    """Yield problems with the forced mass of a lattice of ``cells`` cells with ``masses`` each.

    For a system that is no lattice, ``cells`` is None and ``masses`` is the number of all its masses.
    """
    if nnm.forced is None:
        return
    *cell, mass = nnm.forced
    names_cell = bool(cell)
    is_lattice = cells is not None
    if names_cell != is_lattice:
        yield Problem("nnm.forced", nnm.forced, "give the mass that is forced, [mass], or in a lattice [cell, mass]")
    elif cells is None and mass > masses:
        yield Problem("nnm.forced", nnm.forced, f"is no mass; there are {masses}")
    elif cells is not None and (mass > masses or cell[0] > cells):
        yield Problem("nnm.forced", nnm.forced, f"is no mass; there are {masses} in each of {cells} cells")


def check_size(lattice: LatticeTable, cell: UnitCell) -> list[Problem]:
    """Return the problem of a chain of ``cell`` with more masses than have all their modes computed."""
    dofs = lattice.cells * cell.dofs
    if dofs <= MOST_MASSES:
        return []
    remedy = f'makes {dofs} masses, of at most {MOST_MASSES}; use nnm.system = "condensed" with a start_frequency'
    return [Problem("lattice.cells", lattice.cells, remedy)]


def check_reduced(lattice: LatticeTable, contacts: ContactsTable, cell: UnitCell) -> Iterator[Problem]:
    """Yield problems with keys that do not apply to the reduced model, two masses of one ``cell`` and their contact."""
    if isinstance(contacts.clearance, list) and len(contacts.clearance) != 1:
        yield Problem("contacts.clearance", contacts.clearance, ONE_CONTACT)
    if contacts.clearance is None and lattice.preset is None:
        yield Problem("contacts.clearance", None, "missing; give the clearance in m")
    given = lists_of(contacts)
    for key in ("pair", "next_cell"):
        if getattr(contacts, key) is not None or key in given:
            remedy = "the reduced model has the two masses of cell.contact; remove the key"
            yield Problem(path_of(contacts, key), getattr(contacts, key), remedy)
            return

    if given:
        yield Problem("contacts.each", None, f"{ONE_CONTACT}; remove the lists over sites")
    if cell.is_damped:
        remedy = "the reduced model has no dashpots"
        yield Problem("lattice", "damped", f'{remedy}; remove them, or use system = "chain"')
    for key in ("profiles", "scatter"):
        if getattr(lattice, key):
            remedy = 'the reduced model has one cell; use system = "chain" for cells that differ'
            yield Problem(f"lattice.{key}", None, remedy)
    for key in lattice.nonlinear_keys:
        remedy = 'the reduced model has linear springs; remove quadratic and cubic, or use system = "chain"'
        yield Problem(key, None, remedy)


def check_gaps(contacts: ContactsTable, gaps: Gaps, valid: Valid) -> Iterator[Problem]:
    """Yield problems with contacts that touch at rest; ``gaps`` are the clearances in m on both sides."""
    if not valid("contacts.clearance"):
        return
    if any(0 in gap for gap in gaps):
        remedy = "a contact that touches at rest resists on one side only: no motion about it is linear, however small"
        key = "contacts.clearance"
        if 0 in values_of_sites(contacts, "clearance_minus", len(gaps)):
            key = path_of(contacts, "clearance_minus")
        yield Problem(key, 0.0, f"{remedy}; give a clearance above 0, or a precompression")


def check_lattice(
    lattice: LatticeTable, contacts: ContactsTable, cell: UnitCell, gaps: Gaps, valid: Valid
) -> Iterator[Problem]:
    """Yield problems with the cells and sites of a whole lattice of such cells, with the clearances ``gaps`` in m."""
    yield from check_inhomogeneity(lattice, [])
    sites = site_cells(lattice, contacts)
    if not valid("contacts"):
        return
    yield from check_pairs(lattice, contacts, cell, sites)
    yield from check_joined(lattice, contacts, len(sites))
    if not (sites or lattice.nonlinear_keys):
        yield Problem("contacts.sites", [], f"give cells from 1 to {lattice.cells}")

    yield from _check_held(lattice, contacts, cell, gaps)
    is_symmetric = _is_odd(lattice) and has_equal_sides(gaps)
    # Symmetric motions have no mean forces, and springs that join cells make one body of a lattice.
    if not (cell.joins_cells or is_symmetric):
        chain = build_chain(lattice, contacts)
        yield from check_apart(bodies_of(chain), contact_ends(chain))


def _check_held(lattice: LatticeTable, contacts: ContactsTable, cell: UnitCell, gaps: Gaps) -> Iterator[Problem]:
    """Yield the problem of a lattice that nothing but stops to ground could hold, between which it moves freely.

    ``gaps`` are the clearances in m of its sites on both sides.
    """
    to_ground = _gaps_to_ground(contacts, cell, gaps)
    if not to_ground or is_held(lattice, contacts, cell, gaps):
        return

    fixed = 'use ends = "fixed", or equal stops on both sides'
    if not cell.joins_cells:
        fixed = "press it against the ground (contacts.precompression), or use equal stops on both sides"
    if not has_equal_sides(tuple(to_ground)):
        remedy = "nothing holds this lattice, and a stop to ground that differs on its two sides pushes it away"
        yield Problem(path_of(contacts, "pair"), contacts.pair, f"{remedy}; {fixed}")
    # Symmetric motions pass the centre between the stops. Unsymmetric ones have a mean position, which small motions,
    # without contact, do not determine.
    elif not (has_equal_sides(gaps) and _is_odd(lattice)):
        remedy = (
            "nothing holds this lattice between its stops to ground, and its other forces are not symmetric, so that"
        )
        remedy += f" small motions have no place of their own; {fixed}"
        yield Problem(path_of(contacts, "pair"), contacts.pair, remedy)


def is_held(lattice: LatticeTable, contacts: ContactsTable, cell: UnitCell, gaps: Gaps) -> bool:
    """Return whether springs to walls or ground, or a contact pressed to the ground, hold a lattice at rest."""
    # Springs tie the ends to the walls: a lattice that contacts alone join has none.
    has_walls = lattice.ends == "fixed" and cell.joins_cells
    return has_walls or cell.is_grounded or any(min(gap) < 0 for gap in _gaps_to_ground(contacts, cell, gaps))


def rigid_motions(lattice: LatticeTable, contacts: ContactsTable, cell: UnitCell, gaps: Gaps) -> int:
    """Return how many motions of a valid lattice are those of bodies that nothing holds, so that their frequency is 0.

    Cells that contacts alone join are bodies of their own unless the contacts are pressed at rest. ``gaps`` are the
    clearances in m of its sites on both sides.
    """
    if cell.joins_cells:
        return int(not is_held(lattice, contacts, cell, gaps))
    # One of the bodies is the ground with what is pressed against it.
    return len(set(bodies_of(build_chain(lattice, contacts)))) - 1


def rigid_motions_of_pair(cell: UnitCell) -> int:
    """Return how many motions of the reduced model of a ``cell`` are those of bodies that no spring holds."""
    # Node 0 stands for the middle of a spring to any other mass, where the model holds it.
    nodes = {cell.host: 1, cell.resonator: 2}
    joined = [(0, 0)]
    for spring in cell.springs:
        ends = [spring.start, spring.end]
        if not spring.offset and {*ends} == {*nodes}:
            joined.append((1, 2))
        else:
            joined += [(0, nodes[mass]) for mass in ends if mass in nodes]
    return len(set(connected_groups(3, tuple(joined)))) - 1


def _gaps_to_ground(contacts: ContactsTable, cell: UnitCell, gaps: Gaps) -> list[tuple[float, float]]:
    """Return the clearances on both sides of the contacts with the ground; ``gaps`` are those of all sites."""
    pairs = pairs_of_sites(contacts, cell, len(gaps))
    return [gaps[number] for number, pair in enumerate(pairs) if pair.host < 0]


def _is_odd(lattice: LatticeTable) -> bool:
    """Return whether the springs' forces are odd: no spring of any cell has a quadratic part."""
    varied = [key for key in lattice.nonlinear_keys if key.endswith('.quadratic"')]
    return not varied and not any(spring.quadratic for spring in lattice.undamped_cell().springs)


def check_method(nnm: NnmTable) -> Iterator[Problem]:
    """Yield problems with keys of another method than the one by which motions are found."""
    foreign: tuple[str, ...]
    is_shot = nnm.method == "shooting" and nnm.system != "condensed"
    if not is_shot and nnm.chart != "relative":
        yield Problem("nnm.chart", nnm.chart, "harmonic balance has one chart; remove it, or use shooting")
    if nnm.method == "damped":
        if nnm.system == "condensed":
            yield Problem("nnm.method", "damped", 'needs all masses: nnm.system = "chain", "reduced" or "own"')
        for key in ("switch", "orbits_at", "start_frequency", "start_sites", "forced"):
            if getattr(nnm, key):
                yield Problem(f"nnm.{key}", getattr(nnm, key), "applies to motions without loss; remove it")
        return
    if is_shot:
        method = "harmonic balance"
        foreign = ("start_frequency", "start_sites")
    else:
        method = "shooting"
        foreign = ("switch",)
    for key in foreign:
        given = getattr(nnm, key)
        if given:
            yield Problem(f"nnm.{key}", given, f"applies to motions by {method}; remove it")


def check_condensed(nnm: NnmTable, contacts: ContactsTable, chain: Chain, valid: Valid) -> Iterator[Problem]:
    """Yield problems with the start of motions of the lattice ``chain`` without dashpots, and with its size."""
    yield from check_stiffness(contacts, bool(chain.sites), valid)
    if not nnm.start_frequency:
        yield Problem("nnm.start_frequency", [], "give frequencies in rad/s, between the pass bands or above them")

    # Every place with a nonlinear force has harmonics of its own.
    count = len(chain.sites) + len(nonlinear_springs(chain).cell)
    yield from check_start_sites(nnm, count)

    cell = chain.cell
    masses = cell.dofs * chain.cells
    if needs_modes(chain) and masses > MOST_DOFS:
        remedy = f"{masses} masses: all modes of a lattice with unlike cells or other contact pairs are needed"
        yield Problem("lattice.cells", chain.cells, f"{remedy}, of at most {MOST_DOFS} masses")
    # Cosines alone, since free motions are symmetric in time; motions of odd harmonics have half as many.
    unknowns = count * (nnm.harmonics + 1)
    if not chain.is_linear and unknowns > MOST_UNKNOWNS:
        remedy = f"{count} contacts and nonlinear springs have up to {unknowns} unknown harmonics, of at most"
        yield Problem("nnm.harmonics", nnm.harmonics, f"{remedy} {MOST_UNKNOWNS}; fewer cells or harmonics do")
    # A motion whose frequency is in a band sends waves away, so that it is neither localised nor periodic.
    bands = wave_bands(cell)
    inside = [omega for omega in nnm.start_frequency if any(band.low <= omega <= band.high for band in bands)]
    if inside:
        edges = ", ".join(f"{band.low:.2f}-{band.high:.2f}" for band in bands)
        yield Problem("nnm.start_frequency", inside, f"lies in a pass band ({edges} rad/s); motions there radiate")


def check_damped(nnm: NnmTable, masses: int) -> Iterator[Problem]:
    """Yield the problem of damped modes of too many ``masses``, each of which has harmonics of its own."""
    unknowns = masses * (2 * min(nnm.harmonics, MOST_OF_DAMPED) + 1)
    if nnm.method == "damped" and unknowns > MOST_UNKNOWNS:
        remedy = f"{masses} masses have up to {unknowns} unknown harmonics, of at most {MOST_UNKNOWNS}; decrease it"
        yield Problem("nnm.harmonics", nnm.harmonics, remedy)


def check_start_sites(nnm: NnmTable, count: int) -> Iterator[Problem]:
    """Yield the problem of motions that begin at numbers of sites other than 1 to ``count``; signs are directions."""
    outside = [number for number in nnm.start_sites if not 1 <= abs(number) <= count]
    if outside:
        yield Problem("nnm.start_sites", outside, f"give site numbers from 1 to {count}, with a sign")
