"""The case of the verb ``nfrc``: the lattice, contacts and drive of a run, and ``[nfrc]``."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from math import nan
from typing import Any, ClassVar, NamedTuple

import numpy as np
import tomli_w

from vipetsc.case.bodies import bodies_of, check_apart, contact_ends
from vipetsc.case.case import Case
from vipetsc.case.case_file import Valid
from vipetsc.case.contacts import NO_APPROACH, has_equal_sides, lists_of
from vipetsc.case.drive import DriveTable
from vipetsc.case.nfrc.family import FamilyMember, family_of
from vipetsc.case.nfrc.measures import RESPONSE, ResponseMeasure, measures_of
from vipetsc.case.nfrc.table import NfrcTable
from vipetsc.case.nfrc.varied_key import PARAMETERS, TRIED, is_key, key_problems, table_at
from vipetsc.case.reading import Table, read_section
from vipetsc.case.resolve import build_chain, check_cell, check_stiffness
from vipetsc.case.schema import LatticeTable
from vipetsc.case.section import CaseError, Problem
from vipetsc.case.sites import ContactsTable
from vipetsc.lattice import Chain, Contact, UnitCell, nonlinear_springs, waves_at
from vipetsc.lattice.compliance.by_modes import MOST_DOFS
from vipetsc.lattice.contact import least_restitution
from vipetsc.wording import distinct

MOST_UNKNOWNS = 6000  # harmonics of all places: a dense matrix of 300 MB


class ResponseCurve(NamedTuple):
    """A curve of a case: the ``name`` of its files, its ``case`` without a family, and what is fixed along it.

    ``restitution`` is that of all sites, NaN if each has its own; ``fixed`` is the value of the amplitude or frequency
    that does not vary along the curve; ``member`` is the number (from 0) of its case in the family, ``values`` are
    those of the family's keys.
    """

    name: str
    case: "NfrcCase"
    restitution: float
    fixed: float
    member: int
    values: dict[str, Any]


class FixedParameters(NamedTuple):
    """What is fixed along a curve of one case: the ``restitution`` of all sites, and the value ``fixed``.

    ``name`` is that of the curve among those of the case.
    """

    name: str
    restitution: float
    fixed: float


class NfrcCase(Case):
    """A case of the verb ``nfrc``: that of a run with the section ``[nfrc]``.

    With ``nfrc.family`` its sections are those of the first member; where a key varies along the curves, they are those
    at the lower end of the key's range. In both cases ``table`` is the table from which it was read, else None.
    """

    nfrc: NfrcTable
    table: Table | None = None

    verb = section = "nfrc"
    kept_by_resume: ClassVar[str] = "the case with which its curves were started, except nfrc.points"
    refuses: ClassVar[Mapping[str, str]] = {
        "rigid stops": "the harmonics of an impulse do not decay",
        "initial motion": "steady states do not depend on the motion at t = 0",
        "damped wall": "not yet: a moved wall acts through its spring alone",
        "other waveforms": 'a steady state needs a sine: use waveform = "harmonic" or "burst"',
    }
    waveforms = ("burst", "harmonic")

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the resolved sections, and everything that is wrong with them."""
        if isinstance(table.get("nfrc"), dict) and "family" in table["nfrc"]:
            return cls._read_family(table)
        if isinstance(table.get("nfrc"), dict) and is_key(table["nfrc"].get("over")):
            return cls._read_over_key(table)
        sections, problems = super().read(table)
        if problems:
            return sections, problems

        nfrc = sections["nfrc"]
        contacts = sections["contacts"]
        chain = build_chain(sections["lattice"], contacts)
        cell = chain.cell
        problems = [*_check_drives(nfrc, sections["drive"]), *_check_lattice(nfrc, contacts, chain)]
        if problems:
            return sections, problems

        update: dict[str, Any] = {}
        # Sites with a restitution of their own have no common one by which curves could differ.
        if not (contacts.each and contacts.each.restitution):
            update["restitutions"] = nfrc.restitutions or [contacts.restitution]
        if nfrc.infinite is None:
            update["infinite"] = nfrc.source == "wave" or not needs_modes(chain)
        if nfrc.symmetric is None:
            is_odd = chain.is_odd and has_equal_sides(chain.sites.gaps)
            # In half of an even number of its periods the drive does not change its sign, as such a motion would.
            update["symmetric"] = is_odd and nfrc.subharmonic % 2 == 1
        if nfrc.over == "amplitude":
            update["fixed"] = nfrc.fixed or [sections["drive"].frequency]
        nfrc = nfrc.model_copy(update=update)
        if nfrc.source == "wave" and nfrc.band is None:
            nfrc = nfrc.model_copy(update={"band": _fastest_band(nfrc, cell)})
        problems = [
            *_check_waves(nfrc, cell),
            *check_ground(nfrc, sections["lattice"], chain),
            *_check_points_at(nfrc, measures_of(nfrc, sections["lattice"], sections["output"], chain)),
        ]
        return sections | {"nfrc": nfrc}, problems

    @classmethod
    def _read_family(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the resolved sections of the first member, and everything that is wrong with the first invalid one."""
        family, problems = family_of(table)
        if problems:
            return {}, problems

        read = []
        for member in family.members:
            sections, problems = cls.read(member.table)
            if problems:
                return sections, [replace(p, remedy=f"{p.remedy} (with {member})") for p in problems]
            read.append(sections)
        nfrc = read[0]["nfrc"].model_copy(update={"family": family.table["nfrc"]["family"]})
        return read[0] | {"nfrc": nfrc, "table": family.table}, []

    @classmethod
    def _read_over_key(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return resolved sections at the lower end of a key's range, and everything that is wrong within the range."""
        options, problems = read_section(NfrcTable, table["nfrc"], "nfrc")
        problems = problems or key_problems(table)
        if problems:
            return {}, problems
        low, high = options.range
        read = []
        for place in TRIED:
            value = low + place * (high - low)
            sections: dict[str, Any] = {}
            member, problems = table_at(table, value)
            if not problems:
                sections, problems = cls.read(member)
            if problems:
                varied = f" (with {options.over} = {value:.6g})"
                return sections, [replace(problem, remedy=problem.remedy + varied) for problem in problems]
            read.append(sections)

        chains = [build_chain(sections["lattice"], sections["contacts"]) for sections in read]
        if len({tuple(nonlinear_springs(chain).labels()) for chain in chains}) > 1:
            remedy = f"a spring is linear at {options.over} = {low:g} and has no harmonics; begin at another value"
            return read[0], [Problem("nfrc.range", options.range, remedy)]

        # The band and the restitutions are those at the lower end. The lattice is infinite, or its motions symmetric,
        # only if they are so at all values that were tried.
        of_case: dict[str, Any] = {name: getattr(read[0]["nfrc"], name) for name in ("band", "restitutions")}
        for name in ("infinite", "symmetric"):
            of_case[name] = all(getattr(sections["nfrc"], name) for sections in read)
        return read[0] | {"nfrc": options.model_copy(update=of_case), "table": table}, []

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
        """Yield problems between keys."""
        yield from super().check(sections, valid)
        if not valid("nfrc"):
            return

        nfrc = sections["nfrc"]
        if nfrc.over not in PARAMETERS:
            remedy = "must be amplitude, frequency or the path of a key such as contacts.clearance"
            yield Problem("nfrc.over", nfrc.over, remedy)
            return
        if not nfrc.range[0] > 0:
            yield Problem("nfrc.range", nfrc.range, "must be above 0")
        if nfrc.source == "wave" and nfrc.infinite is False:
            yield Problem(
                "nfrc.infinite", False, 'an incident wave needs an infinite lattice; remove it, or use source = "force"'
            )
        if nfrc.source == "wave" and valid("drive") and sections["drive"].end:
            remedy = 'an incident wave comes from far away; remove drive.end, or set nfrc.source = "force"'
            yield Problem("drive.end", sections["drive"].end, remedy)
        if nfrc.open_ends and valid("lattice", "drive"):
            yield from check_open_ends(sections)
        if nfrc.over == "frequency" and not nfrc.fixed:
            yield Problem("nfrc.fixed", [], "give the amplitudes of the curves over frequency")
        if nfrc.over == "amplitude" and nfrc.isolas and nfrc.subharmonic == 1:
            remedy = (
                "looked for over other amplitudes, along which this curve runs itself; remove it, or vary the frequency"
            )
            yield Problem("nfrc.isolas", nfrc.isolas, remedy)
        if nfrc.curves_of and nfrc.over != "frequency":
            yield Problem(
                "nfrc.curves_of", nfrc.curves_of, 'begin on curves over the frequency: nfrc.over = "frequency"'
            )
        if nfrc.harmonics < nfrc.subharmonic:
            remedy = f"the drive is harmonic {nfrc.subharmonic} of a motion with nfrc.subharmonic periods; increase it"
            yield Problem("nfrc.harmonics", nfrc.harmonics, remedy)
        if nfrc.symmetric and nfrc.subharmonic % 2 == 0:
            yield Problem("nfrc.symmetric", True, "motions of an even number of periods have even harmonics; remove it")
        if not nfrc.smallest_step < nfrc.largest_step:
            yield Problem("nfrc.smallest_step", nfrc.smallest_step, "must be below nfrc.largest_step")

        # Curves are those of sites or of nonlinear springs: without either there is nothing to follow.
        if valid("contacts"):
            contacts = sections["contacts"]
            yield from check_stiffness(contacts, contacts.sites not in (0, []), valid)
            if nfrc.restitutions and contacts.each and contacts.each.restitution:
                remedy = "each site has a restitution of its own, contacts.each.restitution; remove one of them"
                yield Problem("nfrc.restitutions", nfrc.restitutions, remedy)
            dampings = lists_of(contacts).get("damping", [contacts.damping])
            least = max(least_restitution(damping or "paper") for damping in dampings)
            if small := [r for r in nfrc.restitutions if r < least]:
                yield Problem("nfrc.restitutions", small, f"below {least:g} this damping increases without bound")
            if contacts.sites in (0, []) and valid("lattice"):
                cell, _ = check_cell(sections["lattice"])
                if cell is not None and not sections["lattice"].nonlinear_keys:
                    yield from _check_linear(sections, valid)

    def warnings(self) -> list[str]:
        """Return no warnings: those about runs in time do not concern steady states."""
        return []

    def at(self, value: float, amplitude: float) -> "NfrcCase":
        """Return the case whose key ``nfrc.over`` has a ``value``, for states over the amplitude from ``amplitude`` on.

        Raises CaseError where the case is invalid with that value.
        """
        assert self.table is not None
        member, problems = table_at(self.table, value)
        if problems:
            raise CaseError(problems)
        case = NfrcCase.from_table(member | {"name": self.name})
        of_curve = {name: getattr(self.nfrc, name) for name in ("infinite", "symmetric", "band")}
        update = of_curve | {"range": [amplitude, 2 * amplitude], "fixed": [self.frequency]}
        return case.model_copy(update={"nfrc": case.nfrc.model_copy(update=update)})

    def physics(self) -> "NfrcCase":
        """Return the part of the case that a resumed curve must keep: all except the number of points."""
        nfrc = self.nfrc.model_copy(update={"points": 1})
        return self.model_copy(update={"nfrc": nfrc, "table": None})

    def to_toml(self) -> str:
        """Return resolved case as TOML; with keys that vary, the table that was read, since other keys may follow."""
        if self.table is None:
            return super().to_toml()
        table = self.table | {"name": self.name, "nfrc": self.table["nfrc"] | {"points": self.nfrc.points}}
        if self.plugins:
            table["plugins"] = self.plugins.model_dump(by_alias=True, exclude_none=True)
        return tomli_w.dumps(table)

    @property
    def frequency(self) -> float:
        """A frequency of the curves in rad/s: the drive's, the first that is fixed, or the lower end of the range."""
        if self.nfrc.varies_key:
            assert self.drive.frequency is not None  # the case is resolved
            return self.drive.frequency
        if self.nfrc.over == "amplitude":
            return self.nfrc.fixed[0]
        return self.nfrc.range[0]

    def laws(self, restitution: float) -> list[Contact]:
        """Return the law of each site, with the ``restitution`` unless the case gives each site one of its own."""
        laws = [site.law for site in self.model().chain.sites]
        if self.contacts.each and self.contacts.each.restitution:
            return laws
        return [replace(law, restitution=restitution) for law in laws]

    @property
    def is_linear(self) -> bool:
        """Whether the lattice has neither contacts nor nonlinear springs, so that its response is proportional."""
        chain = self.model().chain
        return not chain.sites and chain.is_linear

    @property
    def are_contacts_springs(self) -> bool:
        """Whether contacts that are pressed at rest are springs of the linear lattice, as nothing else holds it."""
        return are_contacts_springs(self.nfrc, self.lattice, self.model().chain)

    @cached_property
    def _members(self) -> list[tuple[FamilyMember, "NfrcCase"]]:
        """The members of the family with their cases; of a case without a family, the case itself."""
        if self.table is None or not self.nfrc.family:
            return [(FamilyMember("", {}, {}), self)]
        family, _ = family_of(self.table | {"nfrc": self.table["nfrc"] | {"points": self.nfrc.points}})
        return [(member, NfrcCase.from_table(member.table | {"name": self.name})) for member in family.members]

    def measures(self) -> dict[str, ResponseMeasure]:
        """Return the measures of its curves, by name: of its sites, and of what ``[output]`` asks for."""
        return measures_of(self.nfrc, self.lattice, self.output, self.model().chain)

    def every_curve(self) -> list[ResponseCurve]:
        """Return the curves of all members of the family; of a case without one its own."""
        curves = []
        for number, (member, case) in enumerate(self._members):
            # Without a family there is one member, whose name is empty.
            for curve in case.curves():
                curves.append(
                    ResponseCurve(
                        name="-".join(filter(None, (member.name, curve.name))),
                        case=case,
                        restitution=curve.restitution,
                        fixed=curve.fixed,
                        member=number,
                        values=member.values,
                    )
                )
        return curves

    def curves(self) -> list[FixedParameters]:
        """Return the curves of the case, or of its first member: one a restitution and value that is fixed."""
        given = self.nfrc.restitutions
        restitutions = [(f"r{name}-", r) for name, r in zip(distinct(given), given, strict=True)]
        values = zip(distinct(self.nfrc.fixed), self.nfrc.fixed, strict=True)
        curves = []
        for (prefix, restitution), (of_value, value) in itertools.product(restitutions or [("", nan)], values):
            curves.append(FixedParameters(f"{prefix}{of_value}", restitution=restitution, fixed=value))
        return curves


def has_waves(chain: Chain) -> bool:
    """Return whether motions of ``chain`` consist of Bloch waves, which are those of equal linear cells without loss.

    Springs must join the cells: waves do not go through contacts unchanged.
    """
    return chain.cell.joins_cells and chain.is_uniform() and chain.is_linear and not chain.is_damped


def needs_modes(chain: Chain) -> bool:
    """Return whether the response of the finite ``chain`` is computed from all of its modes.

    It is if its motions do not consist of Bloch waves, or if contacts join other masses than the cell's pair.
    """
    return not has_waves(chain) or chain.has_own_pairs


def _fastest_band(nfrc: NfrcTable, cell: UnitCell) -> int | None:
    """Return the band of the fastest wave at the frequency at which a curve begins; None in a gap."""
    frequency = nfrc.range[0]
    if nfrc.over == "amplitude":
        frequency = nfrc.fixed[0]
    waves = waves_at(cell, frequency)
    if not waves:
        return None
    band, _, _ = max(waves, key=lambda wave: wave[2])
    return int(band)


def _check_drives(nfrc: NfrcTable, drives: DriveTable) -> Iterator[Problem]:
    """Yield problems with drives besides the first: none acts with an incident wave, and all have one frequency."""
    for path, drive in drives.every[1:]:
        if nfrc.source == "wave":
            yield Problem(path, None, 'an incident wave acts alone; remove it, or set nfrc.source = "force"')
        elif drive.frequency != drives.frequency:
            remedy = "a steady state repeats itself with one period, and so must all drives; give that of the first one"
            yield Problem(f"{path}.frequency", drive.frequency, f"{remedy}, {drives.frequency:.15g} rad/s")


def _check_lattice(nfrc: NfrcTable, contacts: ContactsTable, chain: Chain) -> Iterator[Problem]:
    """Yield problems with a wave, an infinite lattice, or symmetric motions that the lattice does not have."""
    gaps = chain.sites.gaps
    if nfrc.symmetric and not has_equal_sides(gaps):
        yield Problem("nfrc.symmetric", True, "contacts that differ on their two sides make even harmonics; remove it")
    if nfrc.symmetric and not chain.is_odd:
        yield Problem("nfrc.symmetric", True, "a quadratic spring makes even harmonics; remove it")
    smallest = gaps.min(initial=np.inf)
    if smallest < 0 and any(restitution < 1 for restitution in nfrc.restitutions):
        yield Problem("nfrc.restitutions", nfrc.restitutions, NO_APPROACH)
    if nfrc.source == "wave" and smallest <= 0:
        remedy = 'a wave is counted in clearances, and a touching contact has none; use source = "force"'
        yield Problem("nfrc.source", "wave", remedy)
    if not has_waves(chain):
        yield from no_waves(nfrc, chain)

    # The size of the dense matrices by which all modes are computed, and of those of the harmonics.
    if not needs_modes(chain) or nfrc.infinite or nfrc.source == "wave":
        return
    dofs = chain.cells * chain.cell.dofs
    if dofs > MOST_DOFS:
        remedy = f"{dofs} masses: all modes of a lattice with dashpots, unlike cells or other contact pairs are needed"
        yield Problem("lattice.cells", chain.cells, f"{remedy}, of at most {MOST_DOFS} masses")
    elif not chain.is_linear:
        places = len(chain.sites) + len(nonlinear_springs(chain).cell)
        unknowns = places * 2 * (nfrc.harmonics + 1)
        if unknowns > MOST_UNKNOWNS:
            remedy = f"{places} contacts and nonlinear springs have up to {unknowns} unknown harmonics, of at most"
            yield Problem("nfrc.harmonics", nfrc.harmonics, f"{remedy} {MOST_UNKNOWNS}; fewer cells or harmonics do")


def _check_linear(sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
    """Yield problems with the curve of a linear lattice: force or wall, named masses, over amplitude or frequency.

    Other keys of ``[nfrc]`` are of stability and continuation, which it does not have.
    """
    nfrc = sections["nfrc"]
    if nfrc.source == "wave":
        yield Problem("nfrc.source", "wave", 'the lattice is linear, and a wave travels unchanged; use "force"')
    if nfrc.varies_key:
        remedy = "the response of a linear lattice is computed over the frequency; list values in [nfrc.family]"
        yield Problem("nfrc.over", nfrc.over, remedy)
    for key in ("subharmonic", "isolas", "switch", "curves_of", "points_at"):
        value = getattr(nfrc, key)
        if value != NfrcTable.model_fields[key].get_default(call_default_factory=True):
            yield Problem(f"nfrc.{key}", value, "a linear lattice has no such motions; remove it")
    if valid("output") and not (sections["output"].points or sections["output"].forces):
        remedy = "name the masses whose response you want, or give cells with contacts"
        yield Problem("output.points", sections["output"].points, remedy)


def _check_points_at(nfrc: NfrcTable, measures: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield problems with quantities of ``nfrc.points_at`` that states do not have."""
    names = [*PARAMETERS, *(name.removeprefix(RESPONSE) for name in measures)]
    for name in nfrc.points_at:
        if name not in names:
            yield Problem("nfrc.points_at", name, f"use one of {', '.join(names)}")


def _check_waves(nfrc: NfrcTable, cell: UnitCell) -> Iterator[Problem]:
    """Yield problems with frequencies where a curve begins and the band has no wave."""
    if nfrc.source != "wave":
        return
    key = "nfrc.range"
    frequencies = nfrc.range[:1]
    if nfrc.over == "amplitude":
        key = "nfrc.fixed"
        frequencies = nfrc.fixed
    for frequency in frequencies:
        if nfrc.band not in [band for band, *_ in waves_at(cell, frequency)]:
            where = "in no pass band"
            if nfrc.band is not None:
                where = f"not in band {nfrc.band}"
            yield Problem(key, frequency, f"lies {where}, so that no such wave is incident (rad/s)")


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
