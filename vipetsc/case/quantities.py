"""Quantities by name: numbers of the sites, masses, springs and drive of a case that scatter or are sought.

A row of ``QUANTITIES`` says where a quantity stands in the sections of a case. Scatter, identification and trial cases
read its numbers and put others in their place by this row alone.
"""

from collections.abc import Mapping, Sequence
from math import inf
from typing import Any, Literal, NamedTuple

from vipetsc.case.contacts import values_of_sites
from vipetsc.case.drive import DriveTable
from vipetsc.case.schema import CONTACTS, CellTable, LatticeTable, SpringTable
from vipetsc.case.sites import ContactsTable, PerSiteTable
from vipetsc.lattice import UnitCell

Sections = Mapping[str, Any]
"""The sections of a resolved case by their names; ``dict(case)`` gives them."""


class Quantity(NamedTuple):
    """Numbers in SI units that each site, mass or spring of a case has, or its first drive.

    ``key`` is the field of the section, ``text`` says what the numbers are. They are sought within ``least`` and
    ``most``, by default in a coordinate of the ``scale``. ``scattered_as`` is the key in ``[disorder]`` where it is not
    the name.
    """

    name: str
    of: Literal["site", "mass", "spring", "drive"]
    key: str
    unit: str
    text: str
    scale: Literal["logarithmic", "linear"] = "logarithmic"
    least: float = 0.0
    most: float = inf
    may_be_zero: bool = False
    scattered_as: str = ""

    def numbers(self, sections: Sections) -> list[float]:
        """Return the numbers in a resolved case: one for each site, mass or spring, or that of the drive.

        Dashpots are those that the case lists: proportional damping would add to them. Where a side has no clearance of
        its own, that of the other side holds.
        """
        if self.of == "drive":
            return [getattr(sections["drive"], self.key)]
        if self.of == "site":
            return self._of_sites(sections["contacts"])
        cell = sections["lattice"].undamped_cell()
        if self.of == "spring":
            return [getattr(spring, self.key) for spring in cell.springs]
        # A cell without dashpots to ground lists none.
        return list(getattr(cell, self.key)) or [0.0] * cell.dofs

    def _of_sites(self, contacts: ContactsTable) -> list[float]:
        """Return the numbers of the sites of resolved ``contacts``."""
        assert isinstance(contacts.clearance, list)
        if self.key == "clearance":
            return list(contacts.clearance)
        given = values_of_sites(contacts, self.key, len(contacts.clearance))
        if self.key == "clearance_minus":
            return [gap if value is None else value for gap, value in zip(contacts.clearance, given, strict=True)]
        return given

    def put(self, sections: Sections, numbers: Sequence[float]) -> dict[str, Any]:
        """Return ``sections`` with other ``numbers``, which are not checked."""
        if self.of == "drive":
            drive: DriveTable = sections["drive"]
            return {**sections, "drive": drive.model_copy(update={self.key: numbers[0]})}
        if self.of == "site":
            return {**sections, "contacts": self._put_at_sites(sections["contacts"], list(numbers))}

        sections = with_cell_written(sections)
        lattice: LatticeTable = sections["lattice"]
        cell = lattice.cell
        assert cell is not None
        update: dict[str, Any] = {self.key: list(numbers)}
        if self.of == "spring":
            # A dashpot or a nonlinear term of 0 is one that the spring does not have.
            values = [number if number or self.key == "stiffness" else None for number in numbers]
            pairs = zip(cell.springs, values, strict=True)
            update = {"springs": [spring.model_copy(update={self.key: value}) for spring, value in pairs]}
        # The cell no longer is that of the files of matrices that it was made from.
        cell = cell.model_copy(update=update | {"from_matrices": None})
        return {**sections, "lattice": lattice.model_copy(update={"cell": cell})}

    def _put_at_sites(self, contacts: ContactsTable, numbers: list[float]) -> ContactsTable:
        """Return ``contacts`` with other ``numbers``: one for all sites where they are equal, a list otherwise."""
        each = contacts.each
        is_listed = each is not None and getattr(each, self.key, None) is not None
        if self.key == "clearance":
            return contacts.model_copy(update={"clearance": numbers})
        if is_listed and each is not None:
            return contacts.model_copy(update={"each": each.model_copy(update={self.key: numbers})})
        if len(set(numbers)) == 1:
            return contacts.model_copy(update={self.key: numbers[0]})
        # The list has precedence over the number for all sites, which stays that of the case.
        each = (each or PerSiteTable()).model_copy(update={self.key: numbers})
        return contacts.model_copy(update={"each": each})


QUANTITIES: Mapping[str, Quantity] = {
    quantity.name: quantity
    for quantity in (
        Quantity("clearance", "site", "clearance", "m", "each site's clearance"),
        Quantity("clearance_minus", "site", "clearance_minus", "m", "each site's clearance on the side w < 0"),
        Quantity("stiffness", "site", "stiffness", "N/m^n", "the contact stiffness"),
        Quantity("exponent", "site", "exponent", "1", "each site's exponent of the law power", "linear", 1, 10),
        Quantity("restitution", "site", "restitution", "1", "each site's restitution", "linear", 0, 1, True),
        Quantity("mass", "mass", "masses", "kg", "the masses, equal in all cells", scattered_as="masses"),
        Quantity("grounding", "mass", "grounding", "N s/m", "the dashpots from masses to ground", may_be_zero=True),
        Quantity("spring", "spring", "stiffness", "N/m", "the springs, equal in all cells", scattered_as="springs"),
        Quantity("dashpot", "spring", "damping", "N s/m", "the dashpots parallel to springs", may_be_zero=True),
        Quantity("quadratic", "spring", "quadratic", "N/m^2", "quadratic terms of springs", "linear", -inf, inf, True),
        Quantity("cubic", "spring", "cubic", "N/m^3", "cubic terms of springs", "linear", -inf, inf, True),
        # The unit of an amplitude is that of the drive's waveform.
        Quantity("amplitude", "drive", "amplitude", "", "the amplitude of the first drive"),
    )
}


OF_PRESET = ("preset", "lambda", "eta")
"""Keys of ``[lattice]`` that a cell which is written out takes the place of."""


def differs_by_side(contacts: ContactsTable) -> bool:
    """Return whether ``contacts`` have a clearance of their own on the side w < 0."""
    return contacts.clearance_minus is not None or bool(contacts.each and contacts.each.clearance_minus)


def with_cell_written(sections: Sections) -> dict[str, Any]:
    """Return ``sections`` in which the lattice has the table of its cell, without proportional dashpots, for a preset.

    The radius of the preset's spheres, to which indentations are compared, is written out too.
    """
    lattice: LatticeTable = sections["lattice"]
    if lattice.cell is not None:
        return dict(sections)
    cell = table_of(lattice.undamped_cell())
    written: dict[str, Any] = {
        "lattice": lattice.model_copy(update={"cell": cell, "preset": None, "lam": None, "eta": None})
    }
    contacts: ContactsTable = sections["contacts"]
    if contacts.radius is None and contacts.stiffness is not None:
        written["contacts"] = contacts.model_copy(update={"radius": CONTACTS["radius"]})
    return {**sections, **written}


def table_of(cell: UnitCell) -> CellTable:
    """Return the table of a ``cell``, from which the same cell is read."""
    springs = []
    for spring in cell.springs:
        springs.append(
            SpringTable(
                start=spring.start + 1,
                end=spring.end + 1,
                stiffness=spring.stiffness,
                next_cell=spring.offset > 0,
                damping=spring.damping or None,
                quadratic=spring.quadratic or None,
                cubic=spring.cubic or None,
            )
        )
    return CellTable(
        masses=list(cell.masses),
        springs=springs,
        contact=[cell.host + 1, cell.resonator + 1],
        grounding=list(cell.grounding) or None,
    )
