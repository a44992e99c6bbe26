"""The case of the verb ``nnm``: the system, its branches, and how they are followed.

The system itself is built by ``vipetsc.modes.system.System.from_case``.
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field

from vipetsc.case.case_file import CaseFile, Problem, Section, Table, Valid
from vipetsc.case.contacts import check_per_site, parameters_of
from vipetsc.case.features import refusals, refuse_disorder
from vipetsc.case.resolve import (
    check_cell,
    check_sites,
    check_stiffness,
    clearances,
    site_cells,
    with_default_preset,
    with_preset,
)
from vipetsc.case.schema import Finite, LatticeTable, OutputTable, Positive, once
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import Contact, contact_stiffness, pass_bands
from vipetsc.lattice.cell import connected_groups

MOST_MASSES = 4000  # that orbits are solved for with dense matrices
MOST_OF_LATTICE = 40_000  # without any
FEW_MASSES = 100  # of a lattice, beyond which "auto" does without
# Keys of [contacts] that a preset gives, as for a run; the others are those of a run alone.
MATERIAL = "law", "modulus", "radius", "poisson"


class LinearSpringTable(Section):
    """A spring between masses ``start`` and ``end`` (1-based; ``start`` 0 is the ground), N/m."""

    start: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    stiffness: Positive


class SmoothSpringTable(Section):
    """Force ``quadratic`` z^2 + ``cubic`` z^3 (N/m^2, N/m^3) between two masses, as in ``LinearSpringTable``."""

    start: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    cubic: Finite = 0.0
    quadratic: Finite = 0.0


class PairTable(Section):
    """A contact between ``host`` (0 is the ground) and ``resonator`` (1-based) with its ``clearance`` in m."""

    host: Annotated[int, Field(ge=0)]
    resonator: Annotated[int, Field(ge=1)]
    clearance: Positive


class SystemTable(Section):
    """The section [nnm.own]: masses in kg, linear and smooth springs, contact pairs (law: ``[contacts]``)."""

    masses: list[Positive] = Field(min_length=1)
    springs: list[LinearSpringTable] = Field(min_length=1)
    smooth: list[SmoothSpringTable] = Field([])
    contacts: list[PairTable] = Field([])


class Guards(Section):
    """Bounds on one step that keep a branch from jumping to another arc; 0 switches one off.

    Changes of asinh(c) of every Floquet half-trace c and of the number of contact episodes of the arc, length of the
    correction over the step's length, angle in rad between consecutive tangents: in the chart of the step, and in that
    named ``relative``, since near grazing another chart hides the angle between two branches that cross. Residuals
    cannot show a jump: both arcs satisfy the equations to rounding. A branch whose last ``standstill`` points are all
    within ``advance`` times the orbit's size is ended: orbits are corrected to 1e-13, and the paper's branches move by
    2e-6 in 200 points at least.
    """

    half_trace: Annotated[float, Field(ge=0)] = 0.5
    contacts: Annotated[int, Field(ge=0)] = 1
    corrector: Annotated[float, Field(ge=0)] = 0.05
    turn: Annotated[float, Field(ge=0)] = 0.2
    turn_relative: Annotated[float, Field(ge=0)] = 0.25
    standstill: Annotated[int, Field(ge=0)] = 200
    advance: Positive = 1e-9


class NnmTable(Section):
    """Nonlinear normal modes.

    ``system``: ``reduced`` (the paper's model of the cell's contact pair), ``chain`` (the lattice with its sites),
    ``own`` (``[nnm.own]``), or ``condensed`` (the lattice of any length, by harmonics of its sites alone; the
    others with the ``method`` condensed). Branches of these begin at ``start_frequency`` in rad/s, outside the pass
    bands, with contact at ``start_sites`` (numbers of sites, from 1; negative ones move in the opposite direction), and
    take at most ``harmonics``, as many as keep the part left out below ``truncation``. ``modes`` are linear modes
    (1-based, lowest first). ``energy`` in J and ``frequency`` in Hz bound the branch; ``direction`` is where
    energy goes first. ``orbits_at`` lists energies in J: the orbits of these energies, wherever the branch passes one,
    are stored in addition to those of the regions; ``compare`` corrects every fourth point with other flows; ``switch``
    follows the branches that cross at these kinds of special points, ``switch_points`` points each. ``shooting``
    "krylov" does without dense matrices, for a chain on all ranks together ("auto" beyond 100 masses): there and in a
    condensed lattice so many of the largest ``multipliers`` (true: 8) are found.
    """

    system: Literal["reduced", "chain", "own", "condensed"] = "reduced"
    method: Literal["shooting", "condensed"] = "shooting"
    start_frequency: list[Positive] = Field([])
    start_sites: list[int] = Field([])
    harmonics: int = Field(1023, ge=15)
    truncation: Positive = 1e-7
    custom: SystemTable | None = Field(None, alias="own")
    modes: Annotated[list[Annotated[int, Field(ge=1)]], AfterValidator(once)] = Field([1, 2], min_length=1)
    shooting: Literal["auto", "dense", "krylov"] = "auto"
    multipliers: bool | Annotated[int, Field(ge=1)] = False
    map: Literal["auto", "quarter", "half", "whole"] = "auto"
    flow: Literal["compiled", "tsrk", "newmark"] = "compiled"
    jacobian: Literal["variational", "differences"] = "variational"
    chart: Literal["auto", "relative", "logarithmic", "grazing"] = "relative"
    start_energy: Positive | Literal["auto"] = "auto"
    energy: list[Annotated[float, Field(ge=0)]] = Field([0.0, 1e9], min_length=2, max_length=2)
    frequency: list[Annotated[float, Field(ge=0)]] = Field([0.0, 1e9], min_length=2, max_length=2)
    direction: Literal["up", "down", "both"] = "up"
    points: int = Field(20000, ge=1)
    first_step: Positive = 1e-3
    smallest_step: Positive = 1e-13
    largest_step: Positive = 0.1
    tolerance: Positive = 1e-13
    max_newton: int = Field(7, ge=1)
    locate: bool = True
    locate_grazing: bool = True
    orbits_at: list[Positive] = Field([])
    compare: list[Literal["compiled", "tsrk", "newmark"]] = Field([])
    switch: list[Literal["symmetry-breaking", "period-doubling", "branch-point"]] = Field([])
    switch_points: int = Field(100, ge=1)
    switch_amplitude: Positive = 1e-3
    guards: Guards = Guards()

    def is_krylov(self, dofs: int) -> bool:
        """Whether orbits of a lattice of so many masses are shot without dense matrices."""
        needs_dense = self.compare or self.switch or self.flow != "compiled" or self.jacobian != "variational"
        auto = bool(self.start_frequency or self.multipliers) or (dofs > FEW_MASSES and not needs_dense)
        return self.method == "shooting" and self.shooting != "dense" and (auto or self.shooting == "krylov")


class NnmCase(CaseFile):
    """A case of the verb ``nnm``: sections ``[lattice]``, ``[contacts]`` and ``[nnm]``."""

    lattice: LatticeTable
    contacts: ContactsTable
    nnm: NnmTable
    # No part of the case: results that are drawn or not are the same.
    output: Annotated[OutputTable, Field(exclude=True)]

    verb = section = "nnm"
    kept_by_resume: ClassVar[str] = "the system, map and flow with which its branches were started"
    refuses: ClassVar[Mapping[str, str]] = {
        "damping": "a normal mode is a free motion that repeats itself, and none does with dashpots",
        "nonlinear springs": "not yet: only the systems of [nnm.own] have springs that are not linear",
        "profiles": "not yet: normal modes are computed for identical cells",
        "scatter": "not yet: normal modes are computed for identical cells",
        "absorbing ends": "absorbing ends are dashpots, with which no free motion repeats itself",
        "unlike sites": "not yet: normal modes are computed for one law and equal stops on both sides",
        "touching stops": "branches begin with linear motions within the clearance, and without one there are none",
        "disorder": "not yet: normal modes are computed for identical cells and sites",
    }

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """The sections, with the preset's material and clearances, and everything that is wrong with them."""
        contacts = with_preset(table).get("contacts", {})
        nnm = table.get("nnm", {})
        has_no_lattice = isinstance(nnm, dict) and nnm.get("system") == "own"
        if isinstance(contacts, dict) and not has_no_lattice:
            # Of a preset's contacts a run's damping and number of sites do not concern normal modes.
            stated = {*MATERIAL, *table.get("contacts", {})}
            table = table | {"contacts": {key: value for key, value in contacts.items() if key in stated}}

        fields, problems = super().read(with_default_preset(table))
        problems += refuse_disorder(cls, table)
        lattice = fields["lattice"]
        contacts = fields["contacts"]
        if not (problems or has_no_lattice or contacts.clearance):
            count = 1 if fields["nnm"].system == "reduced" else len(site_cells(lattice, contacts))
            fields["contacts"] = contacts.model_copy(update={"clearance": clearances(lattice, contacts, count)})
        return fields, problems

    @property
    def wants_pictures(self) -> bool:
        """Whether the branches are drawn, ``output.figures``."""
        return self.output.figures

    def warnings(self) -> list[str]:
        """Sentences about keys of the case that normal modes ignore."""
        restitution = self.contacts.restitution
        if restitution == 1:
            return []
        return [
            f"contacts.restitution = {restitution:g} is treated as 1: normal modes are computed without dissipation"
        ]

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> list[Problem]:
        """Problems between keys."""
        if not valid("lattice", "contacts", "nnm"):
            return []
        lattice = sections["lattice"]
        contacts = sections["contacts"]
        nnm = sections["nnm"]
        # A user-defined system ignores the section [lattice].
        refusable = {"contacts": contacts} if nnm.system == "own" else {"contacts": contacts, "lattice": lattice}
        problems = [*_check_options(nnm), *refusals(cls, refusable, valid)]
        # Lists over sites are refused above; checking their values too would report them twice.
        if not contacts.each:
            problems += check_per_site(contacts, [], [], valid)

        # Masses of the system, and how many of its lowest modes are motions as a whole.
        dofs = 2
        rigid = 0
        if nnm.system == "own":
            dofs = len(nnm.custom.masses) if nnm.custom else 0
            if nnm.custom and not problems:
                group = connected_groups(dofs + 1, tuple((s.start, s.end) for s in nnm.custom.springs))
                rigid = len(set(group)) - 1
        else:
            cell, wrong = check_cell(lattice)
            problems += wrong

        # The reduced model is one contact pair, and needs no site.
        if nnm.system in ("chain", "condensed"):
            problems += check_sites(lattice, contacts)
            if not site_cells(lattice, contacts):
                problems.append(Problem("contacts.sites", [], f"give cells from 1 to {lattice.cells}"))
        if nnm.system == "chain":
            dofs = cell.dofs * lattice.cells if cell else 2
            rigid = int(lattice.ends != "fixed")  # nothing holds it
            problems += _check_shooting(nnm, dofs)
            too_large = _check_size(nnm, lattice, dofs)
            if too_large:
                return [*problems, *too_large]
        elif nnm.shooting == "krylov" or (nnm.multipliers and nnm.system != "condensed"):
            remedy = '"krylov" is for "chain", multipliers for that and "condensed"'
            problems.append(Problem("nnm.system", nnm.system, remedy))

        if nnm.system == "condensed":
            return [*problems, *_check_condensed(lattice, contacts, nnm, valid)]
        if nnm.system == "reduced":
            problems += _check_one_clearance(lattice, contacts)
        problems += check_stiffness(contacts, nnm.custom is None or bool(nnm.custom.contacts), valid)

        still = [mode for mode in nnm.modes if mode <= rigid]
        if still:
            problems.append(Problem("nnm.modes", still, "the system can move as a rigid body, which has no period"))
        # A number of masses that is wrong itself says nothing about modes.
        beyond = [mode for mode in nnm.modes if mode > dofs]
        if beyond and not problems:
            problems.append(Problem("nnm.modes", beyond, f"the system has {dofs} modes"))
        return problems

    def physics(self) -> tuple[Any, ...]:
        """Keys that a resumed branch must keep: the system, the shooting map and the flow."""
        nnm = self.nnm
        begun = nnm.method, nnm.start_frequency, nnm.start_sites, nnm.truncation, self.krylov
        return self.lattice, self.contacts, nnm.system, nnm.custom, nnm.map, nnm.flow, nnm.jacobian, begun

    @property
    def krylov(self) -> bool:
        """Whether orbits are shot on all ranks together, by matrix-free Newton-Krylov."""
        of_chain = self.nnm.system == "chain"
        return of_chain and self.nnm.is_krylov(self.lattice.unit_cell().dofs * self.lattice.cells)

    @property
    def condensed(self) -> bool:
        """Whether branches are those of motions condensed onto contacts and springs."""
        return self.nnm.system == "condensed" or self.nnm.method == "condensed"

    def contact(self) -> Contact:
        """The contact law without dissipation; the stiffness is 0 in a system without contacts."""
        given = self.contacts
        stiffness = given.stiffness or 0.0
        if given.modulus and given.radius and given.poisson is not None:
            stiffness = contact_stiffness(given.modulus, given.radius, given.poisson)
        return Contact(given.law, stiffness, **parameters_of(given))


def _check_options(nnm: NnmTable) -> Iterator[Problem]:
    """Problems with a user-defined system, and with the bounds of a branch and its steps."""
    if (nnm.system == "own") != (nnm.custom is not None):
        yield Problem("nnm.system", nnm.system, 'a system of one\'s own needs "own" and [nnm.own]')
    for key, (low, high) in (("energy", nnm.energy), ("frequency", nnm.frequency)):
        if not low < high:
            yield Problem(f"nnm.{key}", [low, high], "must be [low, high]")
    if nnm.direction != "up" and not nnm.energy[0] > 0:
        yield Problem("nnm.energy", nnm.energy, "the direction down needs a lowest energy above 0 (J)")

    yield from _check_method(nnm)
    if not nnm.smallest_step < nnm.largest_step:
        yield Problem("nnm.smallest_step", nnm.smallest_step, "must be below nnm.largest_step")
    if nnm.system != "own" or nnm.custom is None:
        return

    masses = len(nnm.custom.masses)
    pairs = [(f"springs[{i}]", s.start, s.end) for i, s in enumerate(nnm.custom.springs, 1)]
    pairs += [(f"smooth[{i}]", s.start, s.end) for i, s in enumerate(nnm.custom.smooth, 1)]
    pairs += [(f"contacts[{i}]", p.host, p.resonator) for i, p in enumerate(nnm.custom.contacts, 1)]
    for key, start, end in pairs:
        if start == end or max(start, end) > masses:
            yield Problem(f"nnm.own.{key}", [start, end], f"is not a pair of the {masses} masses (0 is the ground)")


def _check_size(nnm: NnmTable, lattice: LatticeTable, dofs: int) -> list[Problem]:
    """Problems with a chain of ``dofs`` masses, of which the way that orbits are solved for allows so many."""
    most = MOST_MASSES
    what = "with dense matrices"
    if nnm.is_krylov(dofs):
        most = MOST_OF_LATTICE
        what = "on all ranks"

    if dofs <= most:
        return []
    remedy = f"makes {dofs} masses; orbits are solved for {what}, at most {most}"
    return [Problem("lattice.cells", lattice.cells, remedy)]


def _check_one_clearance(lattice: LatticeTable, contacts: ContactsTable) -> Iterator[Problem]:
    """Problems with the clearance of the reduced model, which has one contact."""
    if isinstance(contacts.clearance, list) and len(contacts.clearance) != 1:
        yield Problem("contacts.clearance", contacts.clearance, "the reduced model has one contact")
    if contacts.clearance is None and lattice.preset is None:
        yield Problem("contacts.clearance", None, "missing; give the clearance in m")


def _check_method(nnm: NnmTable) -> Iterator[Problem]:
    """Keys that belong to the other method than the one by which motions are found."""
    foreign: tuple[str, ...]
    if nnm.system == "condensed" or nnm.method == "condensed":
        method = "shot"
        foreign = ("compare", "switch")
    elif nnm.system == "chain":
        # A start frequency begins a branch of localised motions of a chain: it is not foreign here.
        method = "condensed"
        foreign = ("start_sites",)
    else:
        method = "condensed"
        foreign = ("start_frequency", "start_sites")
    for key in foreign:
        given = getattr(nnm, key)
        if given:
            yield Problem(f"nnm.{key}", given, f"applies to motions that are {method}")


def _check_condensed(lattice: LatticeTable, contacts: ContactsTable, nnm: NnmTable, valid: Valid) -> Iterator[Problem]:
    """Problems with the start of a lattice's motions."""
    yield from check_stiffness(contacts, True, valid)
    if not nnm.start_frequency:
        yield Problem("nnm.start_frequency", [], "give frequencies in rad/s, between the pass bands or above them")

    count = len(site_cells(lattice, contacts))
    outside = [number for number in nnm.start_sites if not 1 <= abs(number) <= count]
    if outside:
        yield Problem("nnm.start_sites", outside, f"give site numbers from 1 to {count}, with a sign")
    if check_cell(lattice)[1]:
        return

    cell = lattice.unit_cell()
    masses = cell.dofs * lattice.cells
    if nnm.multipliers and masses > MOST_OF_LATTICE:
        remedy = f"need the motion of all {masses} masses, and are found up to {MOST_OF_LATTICE}"
        yield Problem(
            "nnm.multipliers", nnm.multipliers, f"{remedy}; multiplier_max needs only the motion of the sites"
        )
    # A motion whose frequency is in a band sends waves away: it is not localised, and nothing is periodic.
    bands = pass_bands(cell)
    inside = [omega for omega in nnm.start_frequency if any(band.low <= omega <= band.high for band in bands)]
    if inside:
        edges = ", ".join(f"{band.low:.2f}-{band.high:.2f}" for band in bands)
        yield Problem("nnm.start_frequency", inside, f"lies in a pass band ({edges} rad/s); motions there radiate")


def _check_shooting(nnm: NnmTable, dofs: int) -> Iterator[Problem]:
    """Keys of [nnm] that do not fit the shooting method of a lattice with ``dofs`` masses."""
    krylov = nnm.is_krylov(dofs)
    if krylov:
        for key in ("compare", "switch", "orbits_at", "flow", "jacobian"):
            if getattr(nnm, key) != NnmTable.model_fields[key].default:
                yield Problem(f"nnm.{key}", getattr(nnm, key), 'needs dense matrices: nnm.shooting = "dense"')
    if nnm.shooting == "dense" and (nnm.multipliers or nnm.start_frequency):
        key = "multipliers" if nnm.multipliers else "start_frequency"
        yield Problem(f"nnm.{key}", getattr(nnm, key), 'needs nnm.shooting = "krylov"; "dense" has all half-traces')
    if krylov and dofs > MOST_MASSES and not nnm.start_frequency:
        yield Problem("nnm.modes", nnm.modes, f"are known up to {MOST_MASSES} masses: give nnm.start_frequency")
