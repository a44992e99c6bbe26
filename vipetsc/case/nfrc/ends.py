"""Supports of the lattice of a steady state: walls, contacts that are pressed at rest, cells beyond its open ends."""

from collections.abc import Iterator
from typing import Any

from vipetsc.case.bodies import bodies_of, check_apart, contact_ends
from vipetsc.case.nfrc.table import NfrcTable
from vipetsc.case.resolve import check_cell
from vipetsc.case.schema import LatticeTable
from vipetsc.case.section import Problem
from vipetsc.lattice import Chain


def has_walls(nfrc: NfrcTable, lattice: LatticeTable) -> bool:
    """Return whether springs tie the ``lattice`` to a wall."""
    is_open = nfrc.infinite
    if nfrc.open_ends and lattice.absorbing:
        is_open = is_open or lattice.absorbing.end == "both"
    return lattice.ends == "fixed" and lattice.unit_cell().joins_cells and not is_open


def are_contacts_springs(nfrc: NfrcTable, lattice: LatticeTable, chain: Chain) -> bool:
    """Return whether the contacts that are pressed at rest are springs of the linear lattice.

    They are if nothing else holds the masses: contacts with the ground in a lattice without walls, and all contacts in
    a lattice without springs. A mean force would push masses that no spring holds away without bound.
    """
    pressed = [site.pair for site in chain.sites if min(site.gaps) < 0]
    if not lattice.unit_cell().joins_cells:
        return bool(pressed)
    return any(pair.host < 0 for pair in pressed) and not has_walls(nfrc, lattice)


def no_waves(nfrc: NfrcTable, chain: Chain) -> Iterator[Problem]:
    """Yield problems with an incident wave or an infinite lattice where motions of ``chain`` are no Bloch waves."""
    reason = "a wave changes its shape in nonlinear springs"
    if not chain.cell.joins_cells:
        reason = "cells that contacts alone join have no linear waves"
    elif chain.is_damped:
        reason = "with dashpots a wave decays before it arrives"
    elif not chain.linearised().is_uniform():
        reason = "cells that differ scatter a wave"
    if nfrc.source == "wave":
        yield Problem("nfrc.source", "wave", f'{reason}; use source = "force"')
    elif nfrc.infinite:
        yield Problem("nfrc.infinite", True, f"{reason}; remove the key, and use absorbing ends")


def check_ground(nfrc: NfrcTable, lattice: LatticeTable, chain: Chain) -> Iterator[Problem]:
    """Yield problems with a mean force of the ground on a lattice that neither a wall nor a pressed contact holds."""
    if nfrc.symmetric:
        return
    # Cells that no springs join must be held together by contacts that are pressed. Springs hold the masses of other
    # lattices together, which only contacts to ground can push away.
    if not (chain.cell.joins_cells or nfrc.infinite):
        yield from check_apart(bodies_of(chain), contact_ends(chain))
        return
    to_ground = bool((chain.sites.table["host"] < 0).any())
    if not to_ground or has_walls(nfrc, lattice) or chain.cell.is_grounded:
        return
    if nfrc.infinite:
        reason = "a mean force of the ground moves an infinite lattice without bound, since no wall holds it"
        yield Problem("contacts.pair", None, f"{reason}; use equal stops on both sides, or nfrc.infinite = false")
    elif not are_contacts_springs(nfrc, lattice, chain):
        reason = "in unsymmetric motions contacts to ground have a mean force, which pushes away a lattice that no wall"
        remedy = 'use ends = "fixed", a precompression, or equal stops on both sides'
        yield Problem("contacts.pair", None, f"{reason} holds; {remedy}")


def check_open_ends(sections: dict[str, Any]) -> Iterator[Problem]:
    """Yield problems with ``nfrc.open_ends``, by which the lattice goes on for ever in place of its absorbing ends."""
    absorbing = sections["lattice"].absorbing
    cell, _ = check_cell(sections["lattice"])
    moved = sections["drive"].end
    if sections["nfrc"].source == "wave":
        yield Problem("nfrc.open_ends", True, "the lattice of an incident wave has no ends; remove the key")
    elif not absorbing:
        yield Problem("nfrc.open_ends", True, "takes the place of absorbing ends; add [lattice.absorbing]")
    elif cell is not None and sections["lattice"].nonlinear_keys:
        remedy = "beyond its ends a lattice has linear springs; remove the key, or quadratic and cubic"
        yield Problem("nfrc.open_ends", True, remedy)
    elif moved and absorbing.end in (moved, "both"):
        yield Problem("drive.end", moved, "no wall moves where the lattice goes on; set lattice.absorbing.end")
