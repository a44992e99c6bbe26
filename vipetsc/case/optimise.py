"""The case of the verb ``optimise``: the variables with their bounds, the objectives and the constraints."""

import copy
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tomli_w
from pydantic import Field

from vipetsc.case.amplitude import amplitude_changes, amplitude_of, amplitude_unit, has_free_amplitude
from vipetsc.case.case import Case
from vipetsc.case.case_file import CaseError, CaseFile, Problem, Section, Table, read_section
from vipetsc.case.disorder import with_cell
from vipetsc.case.law import LawCase
from vipetsc.case.objective import (
    FILE_AMPLITUDE,
    ConstraintTable,
    MeasuredTable,
    ObjectiveTable,
    Pair,
    measured_problems,
)
from vipetsc.case.resolve import with_preset
from vipetsc.case.schema import Positive
from vipetsc.case.study import StudyCase, with_fastest_engine

MOST_DESIGNS = 100_000
Share = Annotated[float, Field(ge=0, le=1)]


class VariablesTable(Section):
    """The variables, each with bounds [low, high]; all except sites and restitution are searched by their logarithm.

    ``clearance`` in m of each site independently, or ``profile``, those of the first and of the last site with the
    others log-spaced between; ``sites``: the cells (1-based), whole numbers that differ; ``restitution``; ``masses`` in
    kg and ``springs`` in N/m of the cell by their number in it (from 1).
    """

    clearance: Pair | None = None
    profile: Pair | None = None
    sites: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    restitution: Annotated[list[Share], Field(min_length=2, max_length=2)] | None = None
    masses: dict[str, Pair] = Field({})
    springs: dict[str, Pair] = Field({})


class OptimiseTable(Section):
    """One objective is searched by CMA-ES, two by NSGA-II, for a Pareto front; designs are to meet each ``constraint``.

    ``start``: the case, or clearances ``matched`` to its wave by the scattering law of a site; ``budget`` in designs,
    the case among them; ``population``: designs a generation; ``step``: first standard deviation over the range between
    the bounds; ``samples`` of what ``[disorder]`` draws are run of every design, and their mean counts; ``curve``:
    amplitudes in N at which the best designs are compared; ``ranks`` share a run.
    """

    variables: VariablesTable = Field(default_factory=lambda: VariablesTable.model_validate({}))
    objective: list[ObjectiveTable] = Field([ObjectiveTable.model_validate({})], min_length=1, max_length=2)
    constraint: list[ConstraintTable] | None = None
    start: Literal["case", "matched"] = "case"
    budget: int = Field(100, ge=2, le=MOST_DESIGNS)
    population: int | None = Field(None, ge=4)
    step: Annotated[float, Field(gt=0, le=1)] = 0.2
    seed: int = Field(1, ge=0)
    samples: int = Field(1, ge=1, le=10_000)
    curve: list[Positive] = Field([])
    ranks: int = Field(1, ge=1)

    @property
    def measured(self) -> list[MeasuredTable]:
        """All that a design is measured for: the objectives, then the constraints."""
        return [*self.objective, *(self.constraint or [])]


class Variable(NamedTuple):
    """A number that varies between ``low`` and ``high``: searched by its logarithm, as it is, or a whole one."""

    name: str
    low: float
    high: float
    unit: str
    kind: Literal["log", "linear", "whole"]

    def to_unit(self, value: float) -> float:
        """The position between the bounds, 0 to 1, of a ``value``."""
        if self.kind == "log":
            return float(np.log(value / self.low) / np.log(self.high / self.low))
        return (value - self.low) / (self.high - self.low)

    def from_unit(self, position: float) -> float:
        """The value at a ``position`` between the bounds, 0 to 1."""
        if self.kind == "log":
            return float(self.low * (self.high / self.low) ** position)
        return self.low + (self.high - self.low) * position


class OptimiseCase(StudyCase):
    """The case to begin with, resolved (``base``), and its ``table`` without ``[optimise]``."""

    options: OptimiseTable
    base: Case

    verb = section = "optimise"

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """The fields, and everything that is wrong with the section or with the case to begin with."""
        remedy = "give the quantities that vary, as in: [optimise.variables] clearance = [1e-4, 1e-2]"
        table, section, missing = cls.divide(table, remedy)
        if missing:
            return {}, missing
        table = with_fastest_engine(table)

        options, problems = read_section(OptimiseTable, section, "optimise")
        try:
            base = _case(table)
            # Designs are built without scatter, and run with it: both must be possible.
            _case(table, table.get("disorder"))
        except CaseError as error:
            return {}, problems + error.problems

        wrong = list(_problems(options, base, "disorder" in table))
        if options.start == "matched":
            wrong += _matched_problems(table)
        invalid = tuple(problem.key for problem in problems)
        problems += [p for p in wrong if not invalid or not p.key.startswith(("optimise.variables", *invalid))]
        return {"table": table, "options": options, "base": base}, problems

    def warnings(self) -> list[str]:
        """Warnings of settings in the initial case that are probably unintended."""
        return self.base.warnings()

    def to_toml(self) -> str:
        """The case as TOML; reading it back gives the same search."""
        section = self.options.model_dump(exclude_none=True)
        return tomli_w.dumps({"name": self.name} | self.table | {"optimise": section})

    def runs(self) -> list[CaseFile]:
        """The case to begin with, of which designs are variations."""
        return [self.base]

    @property
    def amplitude(self) -> float:
        """The amplitude of the case to begin with, of its drive or of its initial motion, in ``amplitude_unit``."""
        return amplitude_of(self.base)

    @property
    def amplitude_unit(self) -> str:
        """The unit of amplitudes."""
        return amplitude_unit(self.base)

    @property
    def wants_pictures(self) -> bool:
        """Whether the results are drawn, ``output.figures`` of the case to begin with."""
        return self.base.output.figures

    @property
    def sites(self) -> list[int]:
        """Cells (1-based) of the sites of the case to begin with."""
        return [site + 1 for site in self.base.model().chain.sites]

    def variables(self) -> list[Variable]:
        """Variables of the search, in the order of the values of a design."""
        bounds = self.options.variables
        numbers = range(1, len(self.sites) + 1)
        rows: list[tuple[list[str], Any, str, Any]] = [
            ([f"clearance {i}" for i in numbers], bounds.clearance, "m", "log"),
            (["first clearance", "last clearance"], bounds.profile, "m", "log"),
            ([f"site {i}" for i in numbers], bounds.sites, "1", "whole"),
            (["restitution"], bounds.restitution, "1", "linear"),
            *(([f"mass {number}"], pair, "kg", "log") for number, pair in bounds.masses.items()),
            *(([f"spring {number}"], pair, "N/m", "log") for number, pair in bounds.springs.items()),
        ]
        return [Variable(n, float(p[0]), float(p[1]), *of) for names, p, *of in rows if p for n in names]

    def begin(self, clearance: Sequence[float] = ()) -> np.ndarray:
        """The values (variable) of the case to begin with, or with other clearances in m, within the bounds."""
        bounds = self.options.variables
        cell = self.base.lattice.unit_cell()
        gaps = list(clearance or self.base.model().chain.clearances)
        values: list[float] = []
        if bounds.clearance:
            values += gaps
        if bounds.profile:
            values += [gaps[0], gaps[-1]]
        if bounds.sites:
            values += self.sites
        if bounds.restitution:
            values.append(self.base.contacts.restitution)
        values += [cell.masses[int(number) - 1] for number in bounds.masses]
        values += [cell.springs[int(number) - 1].stiffness for number in bounds.springs]
        # The case may lie outside the bounds; the search does not.
        return np.clip(values, *np.transpose([(v.low, v.high) for v in self.variables()]))

    def to_unit(self, values: np.ndarray) -> np.ndarray:
        """The point in the unit cube (variable) of ``values``."""
        return np.array([variable.to_unit(x) for x, variable in zip(values, self.variables(), strict=True)])

    def from_unit(self, point: np.ndarray) -> np.ndarray:
        """The values (variable) at a ``point`` of the unit cube; sites in rising order, no two in one cell."""
        variables = self.variables()
        inside = np.clip(point, 0.0, 1.0)
        values = np.array([variable.from_unit(x) for x, variable in zip(inside, variables, strict=True)])

        whole = [i for i, variable in enumerate(variables) if variable.kind == "whole"]
        if whole:
            # Rising without the number of those before, then with it: no two are the same.
            order = np.arange(len(whole))
            last = variables[whole[0]].high
            cells = np.maximum.accumulate(np.sort(np.round(values[whole])) - order)
            values[whole] = np.minimum(cells, last - order[-1]) + order
        return values

    def design(self, values: np.ndarray) -> Case:
        """The case with ``values`` (variable); raises CaseError if it is impossible."""
        bounds = self.options.variables
        count = len(self.sites)
        # Values carry no names: they are consumed in the order of ``variables`` and ``begin``.
        left = iter(map(float, values))
        table = with_preset(copy.deepcopy(self.table))
        contacts = table["contacts"] | {"sites": self.sites, "clearance": [*self.base.model().chain.clearances]}
        if bounds.clearance:
            contacts["clearance"] = [*islice(left, count)]
        if bounds.profile:
            contacts["clearance"] = np.geomspace(next(left), next(left), count).tolist()
        if bounds.sites:
            contacts["sites"] = [int(cell) for cell in islice(left, count)]
        if bounds.restitution:
            contacts["restitution"] = next(left)

        if bounds.masses or bounds.springs:
            cell = self.base.lattice.undamped_cell()
            masses = list(cell.masses)
            stiffness = [spring.stiffness for spring in cell.springs]
            for number in bounds.masses:
                masses[int(number) - 1] = next(left)
            for number in bounds.springs:
                stiffness[int(number) - 1] = next(left)
            table["lattice"] = with_cell(table["lattice"], cell, {"masses": masses, "springs": stiffness})
        return _case(table | {"contacts": contacts})

    def run(self, design: Case, amplitude: float, sample: int | None = None) -> Case:
        """A run of a ``design`` at an ``amplitude``, recorded whole, with the scatter number ``sample`` if given."""
        changes = amplitude_changes(design, amplitude)
        disorder = self.table.get("disorder")
        if sample is not None and disorder is not None:
            # The seed depends on the sample alone, so that all designs meet the same scatter.
            changes["disorder"] = disorder | {"seed": disorder.get("seed", 0) + sample}
        return design.varied(name="design", without=("output",), output=design.output.of_points(), **changes)


def _case(table: Table, disorder: Any = None) -> Case:
    """The run in a ``table``, under one name, with ``disorder`` if that is given; raises CaseError."""
    scatter = {} if disorder is None else {"disorder": disorder}
    return Case.from_table({k: table[k] for k in table if k in Case.model_fields} | {"name": "design"} | scatter)


def _problems(options: OptimiseTable, base: Case, disorder: bool) -> Iterator[Problem]:
    """Problems between the keys of the section and the case to begin with."""
    bounds = options.variables
    sites = base.model().chain.sites
    if not sites:
        yield Problem("contacts.sites", base.contacts.sites, "no sites: without contacts there is nothing to optimise")
    if not any(bounds.model_dump(exclude_none=True).values()):
        valid = ", ".join(VariablesTable.model_fields)
        yield Problem(
            "optimise.variables", None, f"contains no quantity that varies; give [low, high] for any of {valid}"
        )
    yield from _bounds_problems(bounds, base, len(sites))

    if options.samples > 1 and not disorder:
        yield Problem("optimise.samples", options.samples, "there is no [disorder] from which to draw samples")
    if options.start == "matched" and not (bounds.clearance or bounds.profile):
        yield Problem("optimise.start", options.start, "the start matches clearances: let clearance or profile vary")
    if options.curve and not has_free_amplitude(base):
        yield Problem("optimise.curve", options.curve, f"{FILE_AMPLITUDE}; omit it")
    varied = bool(bounds.masses or bounds.springs)
    for number, objective in enumerate(options.objective, 1):
        yield from measured_problems(objective, f"optimise.objective[{number}]", base, varied)
    for number, constraint in enumerate(options.constraint or [], 1):
        at = f"optimise.constraint[{number}]"
        yield from measured_problems(constraint, at, base, varied)
        low, high = constraint.at_least, constraint.at_most
        if low is None and high is None:
            yield Problem(at, None, "has no bound; give at_least, at_most or both")
        elif low is not None and high is not None and low > high:
            yield Problem(f"{at}.at_least", low, f"is above at_most = {high:g}")


def _matched_problems(table: Table) -> Iterator[Problem]:
    """Problems with clearances that are matched by the scattering law of a case that has none."""
    without_scatter = {key: section for key, section in table.items() if key != "disorder"}
    try:
        law = LawCase.from_table(without_scatter | {"name": "law"})
    except CaseError as error:
        for problem in error.problems:
            remedy = f"there is no scattering law by which clearances could be matched: {problem}"
            yield Problem("optimise.start", "matched", remedy)
        return
    if law.model().laws or law.model().chain.pairs:
        remedy = "clearances are matched by the scattering law of one site, and these sites differ; begin with the case"
        yield Problem("optimise.start", "matched", remedy)


def _bounds_problems(bounds: VariablesTable, base: Case, sites: int) -> Iterator[Problem]:
    """Problems with the bounds of what varies in a case with so many ``sites``."""
    at = "optimise.variables"
    if bounds.clearance and bounds.profile:
        yield Problem(f"{at}.profile", bounds.profile, "give clearance or profile, not both")

    cell = base.lattice.unit_cell()
    given = bounds.model_dump(exclude_none=True)
    pairs = {key: pair for key, pair in given.items() if isinstance(pair, list)}
    for kind, count in (("masses", len(cell.masses)), ("springs", len(cell.springs))):
        for number, pair in given[kind].items():
            pairs[f"{kind}.{number}"] = pair
            if not (number.isdecimal() and 1 <= int(number) <= count):
                yield Problem(f"{at}.{kind}.{number}", pair, f"the cell's {kind} are numbered from 1 to {count}")

    for key, (low, high) in pairs.items():
        if key != "sites" and not low < high:
            yield Problem(f"{at}.{key}", [low, high], "must be [low, high] with low below high")
    if bounds.sites:
        low, high = bounds.sites
        if not 1 <= low < high <= base.lattice.cells or high - low + 1 < sites:
            remedy = f"must lie within cells 1 to {base.lattice.cells} and have room for all {sites} sites"
            yield Problem(f"{at}.sites", bounds.sites, remedy)
