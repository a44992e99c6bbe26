"""The contact laws and stops of the sites: one for all sites, or lists over the sites."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vipetsc.case.case_file import Valid
from vipetsc.case.registered import check_factors, check_law, check_law_parameters
from vipetsc.case.schema import LatticeTable
from vipetsc.case.section import Problem
from vipetsc.case.sites import ContactsTable, PerSiteTable
from vipetsc.lattice import Contact, UnitCell, contact_stiffness
from vipetsc.lattice.cell import connected_groups
from vipetsc.lattice.contact import PARAMETERS, RIGID, least_restitution, registered_law
from vipetsc.lattice.sites import Pair

MATERIAL = ("modulus", "radius", "poisson")
SIDES = ("side", "clearance_minus", "precompression")
JOINS = ("pair", "next_cell")
NO_APPROACH = "a precompressed contact has no approach velocity: its restitution must be 1"
Gaps = Sequence[tuple[float, float]] | np.ndarray  # clearances in m of each site on the sides + and -


def lists_of(contacts: ContactsTable) -> dict[str, list[Any]]:
    """Return the lists over sites, ``contacts.each``, by key."""
    if contacts.each is None:
        return {}
    return contacts.each.model_dump(exclude_none=True)


def values_of_sites(contacts: ContactsTable, key: str, count: int) -> list[Any]:
    """Return the value of a ``key`` of ``[contacts]`` at each of ``count`` sites."""
    return lists_of(contacts).get(key) or [getattr(contacts, key)] * count


def is_rigid_of_sites(contacts: ContactsTable, count: int) -> list[bool]:
    """Return whether each of ``count`` sites has a stop that does not yield."""
    return [law == RIGID for law in values_of_sites(contacts, "law", count)]


def is_all_rigid(contacts: ContactsTable) -> bool:
    """Return whether no site has a stop that yields."""
    return set(values_of_sites(contacts, "law", 1)) == {RIGID}


def check_per_site(
    contacts: ContactsTable, gaps: list[float], at_rest: Sequence[bool], valid: Valid
) -> Iterator[Problem]:
    """Yield problems with the laws and stops of sites with clearances ``gaps`` in m, ``at_rest`` (site,) at t = 0."""
    count = len(gaps)
    per_site = lists_of(contacts)
    for key, values in per_site.items():
        if len(values) != count:
            yield Problem(f"contacts.each.{key}", values, f"give one value for each of the {count} sites")
            return

    # A stiffness would contradict a material; the lists over sites may give either.
    has_material = bool(per_site.keys() & {*MATERIAL})
    if has_material and (contacts.stiffness is not None or "stiffness" in per_site):
        remedy = "give it or the material of each site, not both"
        yield Problem(path_of(contacts, "stiffness"), contacts.stiffness, remedy)
        return
    if not valid("contacts"):
        return

    lacking = [key for key in MATERIAL if None in values_of_sites(contacts, key, count)]
    if has_material and lacking:
        yield Problem(f"contacts.{lacking[0]}", None, "missing; needed for the stiffness of each site")
    yield from _check_rigid(contacts, count)
    yield from _check_laws(contacts, count)
    yield from _check_sides(contacts, count)
    # A pressed or touching stop that is wrong by itself would be reported again for its restitution.
    wrong = list(_check_stops(contacts, gaps))
    yield from wrong or check_touching(contacts, gaps, at_rest)


# Keys of stops that yield.
YIELDING = "stiffness", *MATERIAL, "damping", "adhesion", "approach_floor"


def keys_of_other_laws(law: str) -> list[str]:
    """Return keys of ``[contacts]`` that a ``law`` does not take, and others do."""
    keys = [key for key, parameter in PARAMETERS.items() if parameter.law != law]
    if law == RIGID:
        keys += YIELDING
    if registered_law(law) is None:
        keys.append("parameters")
    return keys


def _check_rigid(contacts: ContactsTable, count: int) -> Iterator[Problem]:
    """Yield problems with keys that mean nothing to rigid stops, at all sites, and with precompression.

    A stiffness or a material may be that of other sites.
    """
    if is_all_rigid(contacts):
        given = {"adhesion": contacts.adhesion != "allow", "approach_floor": contacts.approach_floor > 0.0}
        for key in ("stiffness", *MATERIAL, "damping"):
            given[key] = getattr(contacts, key) is not None or key in lists_of(contacts)
        for key, is_given in given.items():
            if is_given:
                remedy = 'a stop of law = "rigid" does not yield, and restitution is all of its dissipation; remove it'
                yield Problem(path_of(contacts, key), getattr(contacts, key), remedy)

    pressed = values_of_sites(contacts, "precompression", count)
    for is_rigid, depth in zip(is_rigid_of_sites(contacts, count), pressed, strict=True):
        if is_rigid and depth:
            remedy = "a rigid stop has no indentation; press a mass on it by a force that is on from t = 0"
            yield Problem(path_of(contacts, "precompression"), depth, remedy)
            return


def _check_laws(contacts: ContactsTable, count: int) -> Iterator[Problem]:
    """Yield problems with parameters of unused laws, missing parameters, and an unbounded damping."""
    # Without sites the values for all sites are checked, here and below: normal modes need no list of sites.
    laws = values_of_sites(contacts, "law", count) or [contacts.law]
    for key, parameter in PARAMETERS.items():
        values = values_of_sites(contacts, key, max(count, 1))
        is_given = any(value is not None for value in values)
        path = path_of(contacts, key)
        if is_given and parameter.law not in laws:
            value = lists_of(contacts).get(key, getattr(contacts, key))
            yield Problem(path, value, f'applies only to law = "{parameter.law}"')
        if parameter.law in laws and not is_given:
            yield Problem(path, None, f'missing; needed for the law "{parameter.law}"')

    yield from _check_registered(contacts, laws, count)
    names = values_of_sites(contacts, "damping", count) or [contacts.damping]
    restitutions = values_of_sites(contacts, "restitution", count) or [contacts.restitution]
    # In the order of their texts, since the default damping, None, cannot be compared with a name.
    for name, restitution in sorted(set(zip(names, restitutions, strict=True)), key=str):
        if name and restitution < least_restitution(name):
            remedy = f"the {name} damping increases without bound towards 0; give at least {least_restitution(name):g}"
            yield Problem(path_of(contacts, "restitution"), restitution, remedy)
    yield from check_factors(path_of(contacts, "damping"), names, restitutions)


def _check_registered(contacts: ContactsTable, laws: list[str], count: int) -> Iterator[Problem]:
    """Yield problems with the ``laws`` of sites that users' modules register: their parameters, and their formulas."""
    given = values_of_sites(contacts, "parameters", max(count, 1))
    wrong = list(check_law_parameters(path_of(contacts, "parameters"), laws, given))
    yield from wrong
    if wrong or not any(registered_law(name) for name in laws):
        return

    # Sites may have parameters of their own: formulas are checked with those of the first site of each law. They are
    # checked with the stiffness 1 where a case lacks one, which is reported elsewhere.
    first: dict[str, Contact] = {}
    for law in laws_of_sites(contacts, count) or [contact_of(contacts)]:
        if registered_law(law.law):
            first.setdefault(law.law, replace(law, stiffness=law.stiffness or 1.0))
    for name, law in first.items():
        reason = check_law(law)
        part = registered_law(name)
        if reason and part:
            yield Problem(path_of(contacts, "law"), name, f"in {part.file}: {reason}")


def _check_sides(contacts: ContactsTable, count: int) -> Iterator[Problem]:
    """Yield the problem of a clearance on a side on which none of ``count`` sites has a stop."""
    is_given = contacts.clearance_minus is not None or "clearance_minus" in lists_of(contacts)
    if is_given and count and set(values_of_sites(contacts, "side", count)) == {"plus"}:
        remedy = 'side = "plus" leaves no stop on the minus side; remove clearance_minus'
        yield Problem(path_of(contacts, "clearance_minus"), contacts.clearance_minus, remedy)


def check_touching(contacts: ContactsTable, gaps: list[float], at_rest: Sequence[bool]) -> Iterator[Problem]:
    """Yield the problem of the first lossy site that touches its stop and is ``at_rest`` (site,) at t = 0.

    ``gaps`` are the clearances in m.
    """
    restitutions = values_of_sites(contacts, "restitution", len(gaps))
    is_rigid = is_rigid_of_sites(contacts, len(gaps))
    for number, (plus, minus) in enumerate(gaps_of_sites(contacts, gaps), 1):
        is_lossy = restitutions[number - 1] < 1 and not is_rigid[number - 1]
        is_singular = is_lossy and contacts.approach_floor == 0
        if min(plus, minus) == 0 and at_rest[number - 1] and is_singular:
            remedy = (
                f"site {number} touches its stop at rest: its first contact has no approach velocity, by which the"
                " damping divides; give restitution = 1, a clearance, or an approach_floor in m/s"
            )
            yield Problem(path_of(contacts, "restitution"), restitutions[number - 1], remedy)
            return


def _check_stops(contacts: ContactsTable, gaps: list[float]) -> Iterator[Problem]:
    """Yield problems with contacts that are closed at rest: a second stop, or an unbounded dissipation."""
    restitutions = values_of_sites(contacts, "restitution", len(gaps))
    precompressions = values_of_sites(contacts, "precompression", len(gaps))
    # Only the first problem is given, since similar sites all have the same.
    for number, (plus, minus) in enumerate(gaps_of_sites(contacts, gaps), 1):
        if precompressions[number - 1] and max(plus, minus) < np.inf:
            remedy = f"site {number} has stops on both sides; a precompressed contact has one: set contacts.side"
            yield Problem(path_of(contacts, "precompression"), precompressions[number - 1], remedy)
            return
        if min(plus, minus) <= 0 and max(plus, minus) < np.inf:
            remedy = "contacts that touch at rest have a stop on one side only; set contacts.side"
            yield Problem("contacts.clearance", min(plus, minus), f"site {number}: {remedy}")
            return
        if min(plus, minus) < 0 and restitutions[number - 1] < 1:
            remedy = f"site {number}: {NO_APPROACH}"
            yield Problem(path_of(contacts, "precompression"), precompressions[number - 1], remedy)
            return


def path_of(contacts: ContactsTable, key: str) -> str:
    """Return the path of a key, in the lists over sites if it is given there."""
    if key in lists_of(contacts):
        return f"contacts.each.{key}"
    return f"contacts.{key}"


def resolved_per_site(contacts: ContactsTable, count: int) -> PerSiteTable | None:
    """Return the lists over sites, with a stiffness in place of a material."""
    if contacts.each is None or not lists_of(contacts).keys() & {*MATERIAL}:
        return contacts.each
    # A key without a list has the same value at all sites.
    rows = zip(*(values_of_sites(contacts, key, count) for key in MATERIAL), strict=True)
    stiffness = [float(contact_stiffness(*row)) for row in rows]
    return contacts.each.model_copy(update=dict.fromkeys(MATERIAL) | {"stiffness": stiffness})


def with_stiffness(contacts: ContactsTable, count: int) -> ContactsTable:
    """Return ``contacts`` with stiffnesses in place of materials, for all sites and in lists over ``count`` sites."""
    # The radius stays: claims and pictures compare indentations with it.
    update: dict[str, Any] = {"each": resolved_per_site(contacts, count)}
    modulus = contacts.modulus
    radius = contacts.radius
    poisson = contacts.poisson
    if contacts.stiffness is None and modulus is not None and radius is not None and poisson is not None:
        update |= {"stiffness": float(contact_stiffness(modulus, radius, poisson)), "modulus": None, "poisson": None}
    return contacts.model_copy(update=update)


def contact_of(contacts: ContactsTable) -> Contact:
    """Return the law of all sites of a resolved case; the stiffness is 0 where none is given."""
    if contacts.law == RIGID:
        return Contact(RIGID, 0.0, restitution=contacts.restitution)
    return Contact(
        contacts.law,
        contacts.stiffness or 0.0,
        restitution=contacts.restitution,
        adhesion=contacts.adhesion,
        approach_floor=contacts.approach_floor,
        factor=contacts.damping or "paper",
        **parameters_of(contacts),
    )


def parameters_of(contacts: ContactsTable) -> dict[str, Any]:
    """Return the values of the parameters that the elastic law of ``contacts`` takes."""
    registered = registered_law(contacts.law)
    if registered:
        given = contacts.parameters or {}
        # One that is missing is reported where the law is checked.
        return {"parameters": tuple(given.get(key, np.nan) for key in registered.parameters)}
    return {key: getattr(contacts, key) for key, about in PARAMETERS.items() if about.law == contacts.law}


def laws_of_sites(contacts: ContactsTable, count: int) -> list[Contact]:
    """Return the law of each of ``count`` sites of a resolved case."""
    per_site = lists_of(contacts)
    # Sides and pairs are no part of a law: the sites of the chain hold them.
    keys = [key for key in per_site if key not in SIDES + JOINS]
    if not count:
        return []
    if not keys:
        return [contact_of(contacts)] * count

    # Each site has the common law, with the changes of the lists; sites with the same changes have one law.
    laws: dict[str, Contact] = {}
    rows = [*zip(*(per_site[key] for key in keys), strict=True)]
    for values in rows:
        if repr(values) not in laws:
            laws[repr(values)] = contact_of(contacts.model_copy(update=dict(zip(keys, values, strict=True))))
    return [laws[repr(values)] for values in rows]


def describe_stops(gaps: Gaps) -> list[str]:
    """Return a description of the stops of each site: its clearance, or by side where sites differ on the two sides."""
    if has_equal_sides(gaps):
        return [f"{1e3 * gap:.4g} mm" for gap, _ in gaps]

    texts = []
    for plus, minus in gaps:
        stops = [_describe_stop(side, gap) for side, gap in (("+", plus), ("-", minus)) if gap < np.inf]
        texts.append(", ".join(stops))
    return texts


def _describe_stop(side: str, gap: float) -> str:
    """Return the description of the stop on one ``side``: its clearance in mm, touching, or precompressed."""
    if gap > 0:
        return f"{1e3 * gap:.4g} mm on side {side}"
    if gap == 0:
        return f"touches on side {side}"
    return f"precompressed by {-1e3 * gap:.4g} mm on side {side}"


def pairs_of_sites(contacts: ContactsTable, cell: UnitCell, count: int) -> list[Pair]:
    """Return the masses (0-based) that each of ``count`` sites joins."""
    pairs = []
    given = values_of_sites(contacts, "pair", count)
    next_cell = values_of_sites(contacts, "next_cell", count)
    for pair, is_in_next_cell in zip(given, next_cell, strict=True):
        host, resonator = pair or (cell.host + 1, cell.resonator + 1)
        pairs.append(Pair(host - 1, resonator - 1, int(bool(is_in_next_cell))))
    return pairs


def check_pairs(lattice: LatticeTable, contacts: ContactsTable, cell: UnitCell, cells: list[int]) -> Iterator[Problem]:
    """Yield problems with the pairs of masses that contacts join, in the ``cells`` (1-based) with sites."""
    # Lists of another length are reported by ``check_per_site``.
    if any(len(lists_of(contacts).get(key, cells)) != len(cells) for key in JOINS):
        return

    pairs = pairs_of_sites(contacts, cell, len(cells))
    for number, (at, pair) in enumerate(zip(cells, pairs, strict=True), 1):
        what = f"site {number} joins masses {pair.host + 1} and {pair.resonator + 1}"
        if max(pair.host, pair.resonator) >= cell.dofs or pair.resonator < 0:
            remedy = f"{what}; the masses of the cell are numbered from 1 to {cell.dofs}, and host 0 is the ground"
            yield Problem(path_of(contacts, "pair"), [pair.host + 1, pair.resonator + 1], remedy)
            return
        if pair.host == pair.resonator and not pair.offset:
            yield Problem(path_of(contacts, "pair"), [pair.host + 1] * 2, f"{what}; did you mean next_cell = true?")
            return
        if pair.offset and (pair.host < 0 or (at == lattice.cells and lattice.ends != "periodic")):
            remedy = f"site {number} in cell {at} has no next cell to touch"
            yield Problem(path_of(contacts, "next_cell"), True, remedy)
            return

    # Where no pair is given, a cell that is listed twice is reported by ``check_sites``.
    has_pair = contacts.pair or (contacts.each and contacts.each.pair)
    times = Counter(zip(cells, pairs, strict=True))
    twice = [at for (at, _), count in times.items() if count > 1]
    if has_pair and twice:
        yield Problem("contacts.sites", twice, "given twice with the same contact pair")
    if cell.springs and not cell.joins_cells and any(pair.offset for pair in pairs):
        yield from _check_loose(cell, pairs)


def check_joined(lattice: LatticeTable, contacts: ContactsTable, count: int) -> Iterator[Problem]:
    """Yield problem of cells of one's own, valid or not, that neither springs nor contacts, ``count`` sites, join."""
    # A single cell has no other one to be joined to.
    if lattice.cell is None or lattice.cells == 1 or not (lattice.cell.springs or count):
        return
    by_springs = any(spring.next_cell for spring in lattice.cell.springs)
    by_contacts = any(values_of_sites(contacts, "next_cell", count))
    if not (by_springs or by_contacts):
        remedy = "neither springs (next_cell) nor contacts (contacts.next_cell) connect the cells"
        yield Problem("lattice.cell.springs", None, remedy)


def _check_loose(cell: UnitCell, pairs: Sequence[Pair]) -> Iterator[Problem]:
    """Yield problem of masses of a ``cell`` that neither springs nor the contacts of ``pairs`` hold in the lattice."""
    # Node 0 stands for the next cell and for the ground: a mass that is not joined to it is part of no lattice.
    joined = [(spring.start + 1, spring.end + 1) for spring in cell.springs]
    for pair in pairs:
        other = pair.resonator + 1
        if pair.offset:
            other = 0
        # The host of a contact with the ground is -1: it is joined to node 0, too.
        joined.append((pair.host + 1, other))
    group = connected_groups(cell.dofs + 1, tuple(joined))
    loose = [str(mass) for mass, number in enumerate(group) if number != group[0]]
    if loose:
        remedy = f"mass {', '.join(loose)} is not connected to the next cell: add springs, or a contact with next_cell"
        yield Problem("lattice.cell.springs", None, remedy)


def gaps_of_sites(contacts: ContactsTable, gaps: Sequence[float]) -> tuple[tuple[float, float], ...]:
    """Return the clearances in m on the sides + and - of each site, inf without a stop."""
    values = [values_of_sites(contacts, key, len(gaps)) for key in SIDES]
    stops = []
    for gap, side, minus_gap, precompression in zip(gaps, *values, strict=True):
        # Displacements count from the state under static load, in which the contact is pressed already.
        pressed = precompression or 0.0
        plus = minus = gap - pressed
        if minus_gap is not None:
            minus = minus_gap - pressed
        if side == "minus":
            plus = np.inf
        elif side == "plus":
            minus = np.inf
        stops.append((plus, minus))
    return tuple(stops)


def has_equal_sides(gaps: Gaps) -> bool:
    """Return whether every site has one clearance on both sides, so that motions may be symmetric."""
    return all(plus == minus for plus, minus in gaps)
