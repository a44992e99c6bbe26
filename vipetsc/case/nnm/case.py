"""The case of the verb ``nnm``: the system, and the branches that are followed.

``vipetsc.modes.system.System.from_case`` builds the system of a case.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache, cached_property
from typing import Annotated, Any, ClassVar

from pydantic import Field

from vipetsc.case.bodies import check_apart
from vipetsc.case.case_file import CaseFile, Valid
from vipetsc.case.contacts import (
    MATERIAL,
    Gaps,
    check_per_site,
    gaps_of_sites,
    has_equal_sides,
    laws_of_sites,
    path_of,
    with_stiffness,
)
from vipetsc.case.disorder import DisorderTable, with_drawn
from vipetsc.case.features import refusals
from vipetsc.case.nnm.checks import (
    ONE_CONTACT,
    check_condensed,
    check_damped,
    check_forced,
    check_gaps,
    check_lattice,
    check_options,
    check_reduced,
    check_rigid_stops,
    check_size,
    check_start_sites,
    rigid_motions,
    rigid_motions_of_pair,
)
from vipetsc.case.nnm.table import NnmTable
from vipetsc.case.reading import Table, read_section
from vipetsc.case.resolve import (
    build_chain,
    check_cell,
    check_sites,
    check_stiffness,
    clearances,
    resolved_contacts,
    site_cells,
    with_default_preset,
    with_preset,
)
from vipetsc.case.schema import LatticeTable, OutputTable
from vipetsc.case.section import Problem, Section
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import Chain, Contact
from vipetsc.lattice.cell import connected_groups

# Keys of [contacts] that normal modes take from a preset. They do not take its restitution and its number of sites,
# which are those of a run.
OF_PRESET = "law", *MATERIAL


class NnmCase(CaseFile):
    """A case of the verb ``nnm``: sections ``[lattice]``, ``[contacts]`` and ``[nnm]``."""

    lattice: LatticeTable
    contacts: ContactsTable
    nnm: NnmTable
    # Not written into a resolved case: whether results are drawn does not change them.
    output: Annotated[OutputTable, Field(exclude=True)]

    verb = section = "nnm"
    kept_by_resume: ClassVar[str] = (
        "the system, and the method, truncation, starts, downward direction and forced mass of [nnm], with which its "
        "branches were started"
    )
    refuses: ClassVar[Mapping[str, str]] = {
        "absorbing ends": "absorbing ends are dashpots, and free motions then decay"
    }

    @classmethod
    @cache
    def sections(cls) -> dict[str, type[Section]]:
        """Return class of each section that the verb reads; a resolved case has drawn values, not ``[disorder]``."""
        return super().sections() | {"disorder": DisorderTable}

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the sections, with the preset's material and clearances, and everything that is wrong with them."""
        contacts = with_preset(table).get("contacts", {})
        nnm = table.get("nnm", {})
        has_no_lattice = isinstance(nnm, dict) and nnm.get("system") == "own"
        if isinstance(contacts, dict) and not has_no_lattice:
            taken = {*OF_PRESET, *table.get("contacts", {})}
            table = table | {"contacts": {key: value for key, value in contacts.items() if key in taken}}

        fields, problems = super().read(with_default_preset(table))
        lattice = fields["lattice"]
        contacts = fields["contacts"]
        # A valid case without a clearance has a preset, from which it follows.
        if not (problems or has_no_lattice or contacts.clearance):
            count = _contact_count(fields["nnm"], lattice, contacts)
            fields["contacts"] = contacts.model_copy(update={"clearance": clearances(lattice, contacts, count)})
        if "disorder" not in table:
            return fields, problems

        disorder, wrong = read_section(DisorderTable, table["disorder"], "disorder")
        system = fields["nnm"].system
        if system in ("reduced", "own"):
            reason = "a system of one's own"
            if system == "reduced":
                reason = f"{ONE_CONTACT} and one cell, which"
            wrong.append(Problem("disorder", None, f"{reason} has nothing that scatters; remove [disorder]"))
        if problems or wrong:
            return fields, problems + wrong
        resolved = fields | {"contacts": resolved_contacts(contacts, lattice)}
        return with_drawn(super().read, resolved, disorder, contacts)

    @property
    def wants_pictures(self) -> bool:
        """Whether the branches are drawn, ``output.figures``."""
        return self.output.figures

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> list[Problem]:
        """Return problems between keys."""
        if not valid("lattice", "contacts", "nnm"):
            return []
        lattice = sections["lattice"]
        contacts = sections["contacts"]
        nnm = sections["nnm"]
        refusable = {"contacts": contacts}
        # A user-defined system ignores the section [lattice].
        if nnm.system != "own":
            refusable["lattice"] = lattice
        problems = [*check_options(nnm), *refusals(cls, refusable, valid), *check_rigid_stops(nnm, contacts)]
        if nnm.system == "own":
            problems += _check_own(nnm, contacts, problems, valid)
            if nnm.custom is not None:
                problems += check_damped(nnm, len(nnm.custom.masses))
            return problems

        cell, wrong = check_cell(lattice)
        problems += wrong
        if nnm.system == "reduced":
            if cell is not None:
                problems += check_reduced(lattice, contacts, cell)
            if not problems:
                problems += _check_stops(contacts, clearances(lattice, contacts, 1), valid)
            problems += check_stiffness(contacts, True, valid)
            problems += check_forced(nnm, None, 2)
            rigid = 0
            if cell is not None:
                rigid = rigid_motions_of_pair(cell)
            return problems + _check_modes(nnm, 2, rigid, problems)

        problems += check_sites(lattice, contacts)
        if problems or cell is None:
            return problems
        sites = site_cells(lattice, contacts)
        given = clearances(lattice, contacts, len(sites))
        problems += _check_stops(contacts, given, valid)
        if problems:
            return problems
        gaps = gaps_of_sites(contacts, given)
        problems += check_lattice(lattice, contacts, cell, gaps, valid)
        if problems:
            return problems

        problems += check_forced(nnm, lattice.cells, cell.dofs)
        if nnm.system == "condensed":
            chain = build_chain(lattice, contacts).without_dashpots()
            return [*problems, *check_condensed(nnm, contacts, chain, valid)]
        problems += check_start_sites(nnm, len(sites))
        problems += check_size(lattice, cell)
        problems += check_stiffness(contacts, bool(sites), valid)
        problems += check_damped(nnm, lattice.cells * cell.dofs)
        rigid = rigid_motions(lattice, contacts, cell, gaps)
        return problems + _check_modes(nnm, lattice.cells * cell.dofs, rigid, problems)

    def physics(self) -> tuple[Any, ...]:
        """Return keys that a resumed branch must keep: the system and where branches begin."""
        nnm = self.nnm
        # Steps, bounds and numbers of points may change from one resumption to the next: the curve is the same.
        begun = nnm.method, nnm.start_frequency, nnm.start_sites, nnm.truncation
        # A branch that is followed downwards alone has the name that one upwards has otherwise.
        goes_down = nnm.direction == "down"
        return self.lattice, self.contacts, nnm.system, nnm.custom, begun, goes_down, nnm.forced

    @property
    def by_balance(self) -> bool:
        """Whether motions are found by harmonic balance between contacts and springs."""
        return self.nnm.system == "condensed" or self.nnm.method == "balance"

    def chain(self) -> Chain:
        """Return the lattice with its sites, without dashpots."""
        return self.damped_chain.without_dashpots()

    @cached_property
    def damped_chain(self) -> Chain:
        """The lattice with its sites and dashpots."""
        return build_chain(self.lattice, self.contacts)

    def forced_mass(self) -> int | None:
        """Return the mass (from 0, through all cells) that the key ``nnm.forced`` names; None without it."""
        if self.nnm.forced is None:
            return None
        *cell, mass = self.nnm.forced
        masses_before = 0
        if cell:
            masses_before = (cell[0] - 1) * self.lattice.unit_cell().dofs
        return masses_before + mass - 1

    def gaps(self) -> Gaps:
        """Return clearances in m of each contact on the sides + and -; inf where there is no stop."""
        return gaps_of_sites(self.contacts, self._clearances())

    def _clearances(self) -> list[float]:
        """Return the clearance in m of each contact, that of the side + unless its only stop is on the side -."""
        if self.nnm.custom is not None:
            return [pair.clearance for pair in self.nnm.custom.contacts]
        count = _contact_count(self.nnm, self.lattice, self.contacts)
        return clearances(self.lattice, self.contacts, count)[:count]

    def laws(self) -> list[Contact]:
        """Return the law of each contact, with its dissipation; the stiffness is 0 where none is given."""
        count = len(self._clearances())
        contacts = with_stiffness(self.contacts, count)
        return laws_of_sites(contacts, count)

    def elastic_laws(self) -> list[Contact]:
        """Return the law of each contact without dissipation."""
        return [replace(law, restitution=1.0) for law in self.laws()]


def _contact_count(nnm: NnmTable, lattice: LatticeTable, contacts: ContactsTable) -> int:
    """Return the number of contacts of a system that is built of the cells of a lattice."""
    if nnm.system == "reduced":
        return 1
    return len(site_cells(lattice, contacts))


def _check_own(nnm: NnmTable, contacts: ContactsTable, wrong: list[Problem], valid: Valid) -> Iterator[Problem]:
    """Yield problems with contacts and modes of a system of one's own, whose keys have the problems ``wrong``."""
    custom = nnm.custom
    if custom is None:
        return
    for key in ("pair", "next_cell"):
        if getattr(contacts, key) is not None or (contacts.each and getattr(contacts.each, key)):
            yield Problem(path_of(contacts, key), None, "[nnm.own] names the masses of each contact; remove the key")
    if nnm.chart == "grazing" and not custom.contacts:
        yield Problem("nnm.chart", "grazing", "its unknown is the gap of a contact, and there is no contact; remove it")
    yield from check_stiffness(contacts, bool(custom.contacts), valid)
    for problem in _check_stops(contacts, [pair.clearance for pair in custom.contacts], valid):
        # The contacts of such a system have their clearances in [nnm.own].
        if problem.key == "contacts.clearance":
            problem = replace(problem, key="nnm.own.contacts")
        yield problem

    masses = len(custom.masses)
    yield from check_forced(nnm, None, masses)
    rigid = 0
    if not wrong:
        joined = [(spring.start, spring.end) for spring in custom.springs]
        # A contact that is pressed at rest is a spring of small motions.
        gaps = gaps_of_sites(contacts, [pair.clearance for pair in custom.contacts])
        for number, gap in enumerate(gaps):
            if min(gap) < 0:
                joined.append((custom.contacts[number].host, custom.contacts[number].resonator))
        # Node 0 is the ground. Each further group of masses moves as a rigid body.
        group = connected_groups(masses + 1, tuple(joined))
        rigid = len(set(group)) - 1
        if not has_equal_sides(gaps):
            smooth = [(spring.start, spring.end) for spring in custom.smooth]
            body = connected_groups(masses + 1, (*joined, *smooth))
            yield from check_apart(body, [(pair.host, pair.resonator) for pair in custom.contacts])
    yield from _check_modes(nnm, masses, rigid, wrong)


def _check_stops(contacts: ContactsTable, given: list[float], valid: Valid) -> Iterator[Problem]:
    """Yield problems with the laws and stops of contacts whose clearances in m are ``given``."""
    problems = list(check_per_site(contacts, given, [False] * len(given), valid))
    yield from problems
    if not problems:
        yield from check_gaps(contacts, gaps_of_sites(contacts, given), valid)


def _check_modes(nnm: NnmTable, dofs: int, rigid: int, wrong: list[Problem]) -> list[Problem]:
    """Return problems with the modes of a system of ``dofs`` masses, the first ``rigid`` of them rigid motions."""
    still = [mode for mode in nnm.modes if mode <= rigid]
    problems = []
    if still:
        problems.append(Problem("nnm.modes", still, "the system can move as a rigid body, which has no period"))
    # Only for a system without other problems, whose number of masses is right.
    beyond = [mode for mode in nnm.modes if mode > dofs]
    if beyond and not (problems or wrong):
        problems.append(Problem("nnm.modes", beyond, f"the system has {dofs} modes"))
    return problems
