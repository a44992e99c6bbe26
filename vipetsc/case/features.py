"""Features of a case that not every verb accepts, and the messages that refuse them.

A case class lists the features that it ``takes``; this module refuses all others. A lattice run accepts all.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from vipetsc.case.case_file import CaseFile, Problem, Table, Valid
from vipetsc.case.contacts import JOINS, SIDES
from vipetsc.case.drive import DriveTable
from vipetsc.case.resolve import check_cell
from vipetsc.case.schema import LatticeTable
from vipetsc.case.sites import ContactsTable

FEATURES = frozenset({
    "damping",  # dashpots
    "nonlinear springs",
    "inhomogeneity",  # cells that differ: profiles, scatter
    "absorbing ends",
    "rings",  # periodic ends
    "unlike sites",  # laws that differ, stops on one side, other masses than the cell's pair, no clearance
    "initial motion",
    "many drives",  # more than one
    "moved wall",
    "disorder",
})  # fmt: skip

# Sections of a lattice whose cells are not all alike, by the feature that they belong to.
UNLIKE_CELLS = {"profiles": "inhomogeneity", "scatter": "inhomogeneity", "absorbing": "absorbing ends"}


def refuse_disorder(kind: type[CaseFile], table: Table) -> list[Problem]:
    """The problem of a section ``[disorder]`` in a ``table`` whose verb does not take it."""
    if "disorder" in table and "disorder" not in kind.takes:
        return [Problem("disorder", None, "this verb does not accept it")]
    return []


def refusals(kind: type[CaseFile], sections: Mapping[str, Any], valid: Valid) -> Iterator[Problem]:
    """Problems of those ``sections`` of a case that the verb of ``kind`` does not take; absent sections have none."""
    if "contacts" in sections and valid("contacts") and "unlike sites" not in kind.takes:
        yield from _unlike_sites(sections["contacts"])

    initial = sections.get("initial")
    if initial and initial.moves and "initial motion" not in kind.takes:
        yield Problem("initial.kind", initial.kind, "this verb treats a wave in a lattice that starts at rest; omit it")

    if "drive" in sections:
        yield from _other_drives(kind, sections["drive"])
    if "lattice" in sections and valid("lattice"):
        yield from _other_lattices(kind, sections["lattice"])


def _unlike_sites(contacts: ContactsTable) -> Iterator[Problem]:
    for key in ("each", *SIDES, *JOINS):
        value = getattr(contacts, key)
        if value is not None:
            remedy = "this verb accepts only one law for all sites and equal stops on both sides; omit it"
            yield Problem(f"contacts.{key}", None if key == "each" else value, remedy)

    clearance = contacts.clearance
    if clearance == 0 or (isinstance(clearance, list) and 0 in clearance):
        yield Problem("contacts.clearance", clearance, "must be positive for this verb")


def _other_drives(kind: type[CaseFile], drive: DriveTable) -> Iterator[Problem]:
    refused = bool(drive.more) and "many drives" not in kind.takes
    refused |= bool(drive.end) and "moved wall" not in kind.takes
    if refused or (kind.waveforms and drive.kind not in kind.waveforms):
        remedy = f"this verb accepts only one {' or '.join(kind.waveforms)} on a mass; run accepts all others"
        yield Problem("drive.waveform", drive.kind, remedy)


def _other_lattices(kind: type[CaseFile], lattice: LatticeTable) -> Iterator[Problem]:
    for key, feature in UNLIKE_CELLS.items():
        if getattr(lattice, key) and feature not in kind.takes:
            yield Problem(f"lattice.{key}", None, f"{kind.premise} with identical cells; omit [lattice.{key}]")

    cell, wrong = check_cell(lattice)
    if cell and not wrong:
        if not cell.is_linear and "nonlinear springs" not in kind.takes:
            remedy = f"{kind.premise} with linear springs; omit quadratic and cubic"
            yield Problem("lattice.cell.springs", None, remedy)
        if cell.is_damped and "damping" not in kind.takes:
            remedy = f"{kind.premise} without dashpots; omit [lattice.damping] and the dashpots of the cell"
            yield Problem("lattice", "damped", remedy)

    if lattice.ends == "periodic" and "rings" not in kind.takes:
        yield Problem(
            "lattice.ends", "periodic", "the prediction does not apply to waves around a ring; use fixed or free ends"
        )
