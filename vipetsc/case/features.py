"""Features of a case that some verbs refuse, and the messages that refuse them.

A case class gives in ``refuses`` the reason why its verb does not accept a feature; it accepts all others. Physics does
not exclude a feature whose reason begins with "not yet": only the code for it is missing.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from vipetsc.case.case_file import CaseFile, Valid
from vipetsc.case.contacts import JOINS, SIDES, lists_of, path_of
from vipetsc.case.drive import DriveTable
from vipetsc.case.reading import Table
from vipetsc.case.resolve import check_cell
from vipetsc.case.schema import LatticeTable
from vipetsc.case.section import Problem
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice.contact import RIGID

FEATURES = {
    "damping": "remove [lattice.damping] and the dashpots of the cell",
    "nonlinear springs": "remove quadratic and cubic",
    "profiles": "remove [lattice.profiles]",
    "scatter": "remove disorder.cells",
    "absorbing ends": "remove [lattice.absorbing]",
    "strips": "remove [lattice.strip]",
    "rings": "use fixed or free ends",
    # Laws that differ, stops on one side, other masses than the cell's pair.
    "unlike sites": "remove the key",
    "touching stops": "give a clearance above 0",
    "rigid stops": 'give a law that yields, as "bilinear" with a large stiffness; `run` and `sweep` accept rigid stops',
    "initial motion": "remove [initial]",
    "many drives": "remove [[drive.more]]",
    "moved wall": "remove drive.end",
    "damped wall": "remove the dashpots of springs to the next cell, stiffness-proportional damping included",
    # Waveforms that the class does not list in ``waveforms``.
    "other waveforms": "`run` accepts every waveform",
    "disorder": "remove [disorder]",
}
"""Features that a verb may refuse, each with the remedy that ends the message."""

# Sections of a lattice whose cells are not all alike, by the feature that they belong to.
UNLIKE_CELLS = {"profiles": "profiles", "scatter": "scatter", "absorbing": "absorbing ends"}


def refuse_disorder(kind: type[CaseFile], table: Table) -> list[Problem]:
    """Return the problem of a section ``[disorder]`` in a ``table`` whose verb does not accept it."""
    if "disorder" not in table:
        return []
    return list(_refusal(kind, "disorder", "disorder"))


def refusals(kind: type[CaseFile], sections: Mapping[str, Any], valid: Valid) -> Iterator[Problem]:
    """Yield problems of features of a case that the verb of ``kind`` refuses; absent ``sections`` have none."""
    if "contacts" in sections and valid("contacts"):
        yield from _unlike_sites(kind, sections["contacts"])

    initial = sections.get("initial")
    if initial and initial.moves:
        yield from _refusal(kind, "initial motion", "initial.kind", initial.kind)

    if "drive" in sections:
        yield from _other_drives(kind, sections["drive"])
    if "lattice" in sections and valid("lattice"):
        moves_wall = "drive" in sections and any(one.end for _, one in sections["drive"].every)
        yield from _other_lattices(kind, sections["lattice"], moves_wall)


def _refusal(kind: type[CaseFile], feature: str, key: str, value: Any = None) -> Iterator[Problem]:
    """Yield problem of a ``feature`` that a case has by the ``value`` of a ``key``, if the verb does not accept it."""
    if feature in kind.refuses:
        yield Problem(key, value, f"{kind.refuses[feature]}; {FEATURES[feature]}")


def _unlike_sites(kind: type[CaseFile], contacts: ContactsTable) -> Iterator[Problem]:
    """Yield problems of sites that differ from one contact of the cell's pair with equal clearances above 0."""
    for key in ("each", *SIDES, *JOINS):
        value = getattr(contacts, key)
        if value is not None:
            # Lists over all sites would fill the message.
            if key == "each":
                value = None
            yield from _refusal(kind, "unlike sites", f"contacts.{key}", value)

    if RIGID in [contacts.law, *lists_of(contacts).get("law", [])]:
        yield from _refusal(kind, "rigid stops", path_of(contacts, "law"), RIGID)

    clearance = contacts.clearance
    if clearance == 0 or (isinstance(clearance, list) and 0 in clearance):
        yield from _refusal(kind, "touching stops", "contacts.clearance", clearance)


def _other_drives(kind: type[CaseFile], drive: DriveTable) -> Iterator[Problem]:
    """Yield problems of further drives, walls that move, and waveforms."""
    if drive.more:
        yield from _refusal(kind, "many drives", "drive.more")
    if drive.end:
        yield from _refusal(kind, "moved wall", "drive.end", drive.end)
    for path, one in drive.every:
        if one.kind not in kind.waveforms:
            yield from _refusal(kind, "other waveforms", f"{path}.waveform", one.kind)


def _other_lattices(kind: type[CaseFile], lattice: LatticeTable, moves_wall: bool) -> Iterator[Problem]:
    """Yield problems of unlike cells, nonlinear springs, dashpots and rings."""
    for key, feature in UNLIKE_CELLS.items():
        if getattr(lattice, key):
            yield from _refusal(kind, feature, f"lattice.{key}")

    if lattice.cell and lattice.cell.from_strip:
        yield from _refusal(kind, "strips", "lattice.strip")
    cell, wrong = check_cell(lattice)
    if cell and not wrong:
        # The first key alone: all of them have one reason and one remedy.
        for key in lattice.nonlinear_keys[:1]:
            yield from _refusal(kind, "nonlinear springs", key)
        if cell.is_damped:
            yield from _refusal(kind, "damping", "lattice", "damped")
        if moves_wall and any(spring.damping for spring in cell.springs if spring.offset):
            yield from _refusal(kind, "damped wall", "drive.end")
    if lattice.ends == "periodic":
        yield from _refusal(kind, "rings", "lattice.ends", lattice.ends)
