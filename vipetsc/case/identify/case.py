"""The case of the verb ``identify``: measured records, and the parameters that are sought in them."""

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from math import inf, isfinite
from typing import Annotated, Any, ClassVar

import tomli_w
from pydantic import Field

from vipetsc.case.case import Case, StudyCase
from vipetsc.case.case_file import CaseFile
from vipetsc.case.features import refusals, refuse_disorder
from vipetsc.case.identify.measured import MeasuredError, RecordTable, read_measured, sensor_problems
from vipetsc.case.identify.sought import (
    SoughtParameter,
    UnknownTable,
    changed_case,
    groups_of,
    parameters_of,
    values_of,
)
from vipetsc.case.identify.trial import TrialCases
from vipetsc.case.quantities import QUANTITIES, differs_by_side
from vipetsc.case.reading import Table, read_section
from vipetsc.case.section import CaseError, Problem, Section, described
from vipetsc.case.warnings import loss_warnings, unit_warnings
from vipetsc.case.waveforms import OneDrive
from vipetsc.lattice.contact import LAWS

DASHPOTS = ("dashpot", "grounding")
MOST_MASSES = 200
"""Masses of a lattice whose initial state is estimated, at most.

Each has two unknowns, and a derivative by an unknown takes two runs: 800 runs for each step of a fit.
"""


class IdentifyTable(Section):
    """Parameters are fitted to ``records`` over windows that grow, from one or several starts.

    The first start is that of the unknowns; the others are drawn between their bounds by Latin hypercube sampling.
    """

    records: list[RecordTable] = described("measured records", [])
    unknowns: list[UnknownTable] = described("parameters that are sought", [])
    impacts: int = described("contacts of the model in the first window", 4, ge=1)
    growth: Annotated[float, Field(gt=1, le=100)] = described("contacts of a window over those of the one before", 1.6)
    starts: int = described("number of starts; all but the first are drawn between the bounds", 1, ge=1, le=10_000)
    seed: int = described("seed of the starts", 1, ge=0)
    steps: int = described("largest number of evaluations of the model in one window", 30, ge=1, le=10_000)
    confidence: Annotated[float, Field(gt=0, lt=1)] = described("confidence of the intervals", 0.9)
    profile: int = described(
        "values of each parameter at which all others are fitted; 0: no profiles", 5, ge=0, le=1000
    )


class IdentifyCase(StudyCase):
    """The case whose parameters are sought, resolved (``base``), and its ``table`` without ``[identify]``."""

    options: IdentifyTable
    base: Case

    verb = section = "identify"
    refuses: ClassVar[Mapping[str, str]] = {
        "disorder": "the lattice that was measured does not scatter",
        "rigid stops": "not yet: derivatives have no jumps at impulses",
    }

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the fields, and everything that is wrong with the section, the data or the case."""
        remedy = "give [[identify.records]] with their sensors, and [[identify.unknowns]]"
        table, section, missing = cls.divide(table, remedy)
        if missing:
            return {}, missing

        options, problems = read_section(IdentifyTable, section, "identify")
        problems += refuse_disorder(cls, table)
        try:
            base = Case.from_table({k: table[k] for k in table if k in Case.model_fields} | {"name": "model"})
        except CaseError as error:
            return {}, problems + error.problems
        # The case is valid. This verb may not support all of its features.
        problems += refusals(cls, dict(base), lambda *keys: True)
        if not options.records:
            problems.append(Problem("identify.records", [], remedy))
        # The clock of a record may be all that is sought.
        if not options.unknowns and not any(isinstance(record.offset, list) for record in options.records):
            problems.append(Problem("identify.unknowns", [], remedy))
        if problems:
            return {}, problems

        fields = {"table": table, "options": options, "base": base}
        # Data are read last, since files may be large, and not at all for a case that is refused.
        problems = [*_unknown_problems(options, base), *_record_problems(options, base)]
        if problems:
            return fields, problems
        fields["options"], problems = _with_hashes(options)
        return fields, problems

    def warnings(self) -> list[str]:
        """Return warnings of settings in the case that are probably unintended."""
        # Warnings about times and samples of a run do not apply: those of the records are used.
        return [*unit_warnings(self.base.drive, self.base.model().chain), *loss_warnings(self.base.lattice)]

    def to_toml(self) -> str:
        """Return the case as TOML; reading it back gives the same identification."""
        section = self.options.model_dump(exclude_none=True)
        return tomli_w.dumps({"name": self.name} | self.table | {"identify": section})

    def runs(self) -> list[CaseFile]:
        """Return the case whose parameters are sought."""
        return [self.base]

    @property
    def wants_pictures(self) -> bool:
        """Whether the results are drawn, ``output.figures`` of the case."""
        return self.base.output.figures

    @cached_property
    def parameters(self) -> list[SoughtParameter]:
        """The parameters that are sought: the unknowns one by one, then offsets of records."""
        parameters = []
        for unknown in self.options.unknowns:
            parameters += parameters_of(unknown, self.base)

        for number, record in enumerate(self.options.records):
            if isinstance(record.offset, list):
                low, high = record.offset
                name = "offset"
                if len(self.options.records) > 1:
                    name += f" {number + 1}"
                parameters.append(
                    SoughtParameter(
                        name=name,
                        quantity="offset",
                        members=(number,),
                        low=low,
                        high=high,
                        # The middle of the bounds: the case has no clock of a record from which to begin.
                        start=(low + high) / 2,
                        unit="s",
                        is_logarithmic=False,
                    )
                )
        return parameters

    def case_of(self, values: Iterable[float], name: str = "model") -> Case:
        """Return the case with the ``values`` (parameter,); raises CaseError if it is impossible."""
        return changed_case(self.base, self.parameters, values, name)

    def trials(self, number: int) -> TrialCases:
        """Return cases of the record of that ``number`` (from 0), with its drive and its initial motion."""
        return TrialCases(self.base, self.parameters, _varied_sections(self.options.records[number]))


def _varied_sections(record: RecordTable) -> dict[str, Any]:
    """Return the sections of a case in which a ``record`` differs from it."""
    sections = {}
    if record.drive:
        # A copy: tables are changed as they are read.
        sections["drive"] = copy.deepcopy(record.drive)
    if isinstance(record.initial, dict) and record.initial:
        sections["initial"] = copy.deepcopy(record.initial)
    return sections


def _group_problems(
    unknown: UnknownTable, groups: Sequence[Sequence[int]], base: Case, taken: set[tuple[str, int]], at: str
) -> Iterator[Problem]:
    """Yield problems of the ``groups`` of members of an ``unknown`` at the path ``at``; each group has one value.

    ``taken`` are the pairs of a quantity and a member that are sought already. Those of the unknown are added to it.
    """
    quantity = unknown.quantity
    gaps = base.model().chain.sites.gaps
    for group in groups:
        if quantity == "clearance_minus" and all(not isfinite(gaps[member][1]) for member in group):
            remedy = f"site {group[0] + 1} has no stop on the side w < 0; name the other sites, as in of = [[1], [2]]"
            yield Problem(f"{at}.of", unknown.of, remedy)
        for member in group:
            if (quantity, member) in taken:
                yield Problem(f"{at}.of", unknown.of, f"{quantity} {member + 1} is sought twice")
            taken.add((quantity, member))


def _unknown_problems(options: IdentifyTable, base: Case) -> Iterator[Problem]:
    """Yield problems of the unknowns in a case."""
    # Pairs of a quantity and a member: two unknowns that change one value would not be determined.
    taken: set[tuple[str, int]] = set()
    for index, unknown in enumerate(options.unknowns, 1):
        at = f"identify.unknowns[{index}]"
        quantity = unknown.quantity
        values = values_of(base, quantity)
        yield from _bounds_problems(unknown, at)

        # The quantity is one that the case has.
        if quantity == "clearance_minus" and not differs_by_side(base.contacts):
            remedy = "the case has no other clearance on the side w < 0; set contacts.clearance_minus"
            yield Problem(f"{at}.quantity", quantity, remedy)
            continue
        if not values:
            yield Problem(f"{at}.quantity", quantity, "the case has no contact sites")
            continue

        # The quantity can be sought in this case.
        if quantity == "exponent" and any(law.law != "power" for law in base.model().chain.sites.laws):
            yield Problem(f"{at}.quantity", quantity, 'only the law "power" has an exponent; set contacts.law')
        if quantity == "stiffness" and any(law.law not in LAWS for law in base.model().chain.sites.laws):
            remedy = "a registered law need not be proportional to its stiffness; only shipped laws can be identified"
            yield Problem(f"{at}.quantity", quantity, remedy)
        if quantity == "amplitude" and all("amplitude" in record.drive for record in options.records):
            yield Problem(f"{at}.quantity", quantity, "every record gives its amplitude; none is left to be sought")
        if QUANTITIES[quantity].of in ("mass", "spring") and (base.lattice.profiles or base.lattice.absorbing):
            remedy = (
                "masses, springs and dashpots are sought in lattices of equal cells only; remove profiles and absorbing"
            )
            yield Problem(f"{at}.quantity", quantity, remedy)
        if quantity in DASHPOTS and any(value == 0 for value in values) and unknown.start is None:
            what = {"dashpot": "springs", "grounding": "masses"}[quantity]
            yield Problem(f"{at}.start", None, f"missing; the case has {what} without a dashpot to begin with")

        # The members exist, and each value has a start within the bounds.
        groups = groups_of(unknown, len(values))
        wrong = [member + 1 for group in groups for member in group if not 0 <= member < len(values)]
        if wrong or not all(groups):
            yield Problem(f"{at}.of", unknown.of, f"numbers are from 1 to {len(values)}, one or more in each group")
            continue
        yield from _group_problems(unknown, groups, base, taken, at)
        starts: list[float | None]
        if not isinstance(unknown.start, list):
            starts = [unknown.start]
        else:
            starts = [*unknown.start]
            if len(starts) != len(groups):
                yield Problem(f"{at}.start", unknown.start, f"give one number for each of the {len(groups)} values")
        low, high = unknown.bounds
        if any(start is not None and not low <= start <= high for start in starts):
            yield Problem(f"{at}.start", unknown.start, f"must lie within the bounds {low:g} and {high:g}")


def _bounds_problems(unknown: UnknownTable, at: str) -> Iterator[Problem]:
    """Yield problems of bounds beyond what the quantity may be, or its logarithm."""
    low, high = unknown.bounds
    quantity = QUANTITIES[unknown.quantity]
    is_linear = (unknown.scale or quantity.scale) == "linear"
    if not (quantity.least <= low and high <= quantity.most):
        remedy = f"must be between {quantity.least:g} and {quantity.most:g}"
        if quantity.most == inf:
            remedy = "must not be negative" if quantity.may_be_zero else "must be positive"
        yield Problem(f"{at}.bounds", unknown.bounds, remedy)
    elif low <= 0 and not (is_linear and quantity.may_be_zero):
        remedy = "must be positive"
        if quantity.may_be_zero:
            remedy += ', or give scale = "linear"'
        yield Problem(f"{at}.bounds", unknown.bounds, remedy)


def _record_problems(options: IdentifyTable, base: Case) -> Iterator[Problem]:
    """Yield problems of the records' keys, their sensors and their drives."""
    dofs = base.lattice.unit_cell().dofs
    masses = base.lattice.cells * dofs
    for number, record in enumerate(options.records, 1):
        at = f"identify.records[{number}]"
        # The columns of the record itself.
        if (record.time is None) == (record.rate is None):
            yield Problem(f"{at}.time", record.time, "give the column of times or the rate in Hz, one of both")

        # The case of the record, which may have other drives.
        case = base
        try:
            case = base.varied(**_varied_sections(record))
        except CaseError as error:
            for problem in error.problems:
                # The case itself is valid, so that the problem is one of the record's keys.
                yield replace(problem, key=f"{at}.{problem.key}")
        else:
            yield from _force_problems(record, [drive for _, drive in case.drive.every], at)
        yield from sensor_problems(record, at, cells=base.lattice.cells, dofs=dofs, drives=len(case.drive.every))

        if record.initial == "estimate" and masses > MOST_MASSES:
            remedy = f"of {masses} masses is too much to estimate; {MOST_MASSES} masses are possible"
            yield Problem(f"{at}.initial", "estimate", remedy)
        if record.initial == "estimate" and all(sensor.quantity == "force" for sensor in record.sensors):
            yield Problem(f"{at}.initial", "estimate", "needs a sensor of motion; a drive's force says nothing of it")

        if not record.contact and _touches(base):
            remedy = "a site touches or is pressed at rest; set it to true"
            yield Problem(f"{at}.contact", False, remedy)

    # Without contact the misfit does not depend on quantities of sites, and the fit would be singular.
    if not any(record.contact for record in options.records):
        for index, unknown in enumerate(options.unknowns, 1):
            if QUANTITIES[unknown.quantity].of == "site":
                remedy = "no record has contact: a lattice that does not touch says nothing about its contacts"
                yield Problem(f"identify.unknowns[{index}].quantity", unknown.quantity, remedy)


def _touches(base: Case) -> bool:
    """Return whether a site of the case touches its stop, or is pressed against it, at rest."""
    return bool((base.model().chain.sites.gaps <= 0).any())


def _force_problems(record: RecordTable, drives: Sequence[OneDrive], at: str) -> Iterator[Problem]:
    """Yield problems of sensors of a drive's force; ``drives`` are those of the ``record``."""
    for number, sensor in enumerate(record.sensors, 1):
        drive = sensor.drive or 1
        if sensor.quantity != "force" or drive > len(drives):
            continue
        key = f"{at}.sensors[{number}].quantity"
        if drives[drive - 1].end:
            # What a load cell at the wall measures is the force of the spring, by the motion of wall and mass.
            remedy = f"drive {drive} moves a wall, whose force depends on the lattice's motion; measure that of a mass"
            yield Problem(key, "force", remedy)
        elif drives[drive - 1].amplitude == 0:
            yield Problem(key, "force", f"drive {drive} has no amplitude; set it, or remove this sensor")


def _with_hashes(options: IdentifyTable) -> tuple[IdentifyTable, list[Problem]]:
    """Return the ``options`` with the hash of every record's file, and what is wrong with the data."""
    records = []
    problems = []
    for number, record in enumerate(options.records, 1):
        # A record with a hash belongs to a resolved case, of which results are read where the data are gone.
        if record.sha256 is None:
            try:
                record = record.model_copy(update={"sha256": read_measured(record).sha256})
            except MeasuredError as error:
                problems.append(Problem(f"identify.records[{number}].{error.key}", error.value, error.remedy))
        records.append(record)
    return options.model_copy(update={"records": records}), problems
