"""Masses that move as one body in small motions of a lattice whose cells contacts alone join."""

from collections.abc import Iterator, Sequence

from vipetsc.case.section import Problem
from vipetsc.lattice import Chain, contacts
from vipetsc.lattice.cell import GROUND, connected_groups


def contact_ends(chain: Chain) -> list[tuple[int, int]]:
    """Return the numbers of host and resonator of each site: 0 for the ground, masses from 1 on, cell by cell."""
    # The ground is the number -1 of a contact's ends.
    return [(1 + host, 1 + resonator) for host, resonator in contacts(chain).mass_pairs()]


def bodies_of(chain: Chain) -> list[int]:
    """Return the body of the ground, and behind it that of each mass of ``chain``, by the numbers of ``contact_ends``.

    Springs, which are all within cells or to the ground, join the masses of a body, and so do contacts that are pressed
    at rest.
    """
    d = chain.cell.dofs
    pressed = [ends for ends, site in zip(contact_ends(chain), chain.sites, strict=True) if min(site.gaps) < 0]
    sprung = []
    for cell in range(chain.cells):
        for spring in chain.cell.springs:
            start = 0
            if spring.start != GROUND:
                start = 1 + cell * d + spring.start
            sprung.append((start, 1 + cell * d + spring.end))
    # A node is joined to itself, so that there is a pair where nothing else is joined.
    return connected_groups(1 + chain.cells * d, ((0, 0), *sprung, *pressed))


def check_apart(body: Sequence[int], ends: Sequence[tuple[int, int]]) -> Iterator[Problem]:
    """Report the first site whose contact joins two separate bodies (a problem only for asymmetric motions).

    ``body`` is that of each mass by its number, 0 of the ground; ``ends`` are the numbers that each site joins.
    """
    for number, (host, resonator) in enumerate(ends, 1):
        if body[host] != body[resonator]:
            cause = f"site {number} joins masses that neither springs nor pressed contacts join"
            effect = "in asymmetric motions its mean force pushes them apart"
            remedy = "give a precompression, or equal stops on both sides"
            yield Problem("contacts.clearance", None, f"{cause}: {effect}; {remedy}")
            return
