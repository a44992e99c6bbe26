"""The case of the verb ``optimise``: the variables with their bounds, the objectives and the constraints."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import Field

from vipetsc.case.amplitude import amplitude_changes, amplitude_of, amplitude_unit, has_free_amplitude
from vipetsc.case.case import Case, StudyCase
from vipetsc.case.case_file import CaseFile
from vipetsc.case.law import LawCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise.objective import (
    FILE_AMPLITUDE,
    ConstraintTable,
    MeasuredTable,
    ObjectiveTable,
    measured_problems,
)
from vipetsc.case.optimise.problems import variable_problems, variable_warnings
from vipetsc.case.optimise.search_space import SearchSpace, case_of, search_space
from vipetsc.case.optimise.variables import Variable, VariablesTable
from vipetsc.case.reading import Table, read_section
from vipetsc.case.schema import Positive
from vipetsc.case.section import CaseError, Problem, Section, described, is_within

# Designs of a search: with a run of 0.3 s for each, as of the built-in case, so many take eight hours.
MOST_DESIGNS = 100_000
AMPLITUDES = ("drive.amplitude", "initial.amplitude", "initial.energy", "initial.velocity")


class OptimiseTable(Section):
    """A search for designs: of one ``objective`` by CMA-ES, of two by NSGA-II, which finds a Pareto front."""

    variables: VariablesTable = described(
        "quantities that vary", default_factory=lambda: VariablesTable.model_validate({})
    )
    objective: list[ObjectiveTable] = described(
        "one objective (CMA-ES), or two (NSGA-II, a Pareto front)",
        [ObjectiveTable.model_validate({})],
        min_length=1,
        max_length=2,
    )
    constraint: list[ConstraintTable] | None = described("bounds of measures that a design must satisfy", None)
    start: Literal["case", "matched"] = described(
        "initial design: the case, or clearances matched to its wave by the scattering law of one site", "case"
    )
    budget: int = described("number of designs, including the case", 100, ge=2, le=MOST_DESIGNS)
    population: int | None = described("number of designs per generation", None, ge=4)
    step: Annotated[float, Field(gt=0, le=1)] = described(
        "initial standard deviation over the range between the bounds", 0.2
    )
    seed: int = described("seed of the search", 1, ge=0)
    samples: int = described("samples of [disorder] for each design, whose mean counts", 1, ge=1, le=10_000)
    curve: list[Positive] = described("amplitudes at which the best designs are compared", [], unit="N or as the drive")
    ranks: int = described("number of ranks per run", 1, ge=1)

    @property
    def measured(self) -> list[MeasuredTable]:
        """All that a design is measured for: the objectives, then the constraints."""
        return [table for _, table in self.measured_at]

    @property
    def measures_responses(self) -> bool:
        """Whether any objective or constraint is measured of frequency responses."""
        return any(table.is_of_responses for table in self.measured)

    @property
    def measures_runs(self) -> bool:
        """Whether any objective or constraint is measured of runs."""
        return not all(table.is_of_responses for table in self.measured)

    @property
    def measured_at(self) -> list[tuple[str, MeasuredTable]]:
        """Pairs of the path of an objective or a constraint and its table; the objectives come first."""
        rows: list[tuple[str, MeasuredTable]] = []
        rows += [(f"optimise.objective[{i}]", objective) for i, objective in enumerate(self.objective, 1)]
        rows += [(f"optimise.constraint[{i}]", bound) for i, bound in enumerate(self.constraint or [], 1)]
        return rows


class OptimiseCase(StudyCase):
    """The case to begin with, resolved (``base``), and its ``table`` without ``[optimise]``."""

    options: OptimiseTable
    base: Case

    verb = section = "optimise"

    @classmethod
    def read(cls, table: Table) -> tuple[dict[str, Any], list[Problem]]:
        """Return the fields, and everything that is wrong with the section or with the case to begin with."""
        remedy = "give the quantities that vary, as in: [optimise.variables] clearance = [1e-4, 1e-2]"
        table, section, missing = cls.divide(table, remedy)
        if missing:
            return {}, missing

        options, problems = read_section(OptimiseTable, section, "optimise")
        try:
            base = case_of(table)
            # Designs are built without scatter, and run with it: both must be possible.
            case_of(table, table.get("disorder"))
            responses = None
            if options.measures_responses and "nfrc" in table:
                responses = responses_of(base, table["nfrc"])
        except CaseError as error:
            return {}, problems + error.problems

        wrong = list(_problems(options, base, table, responses))
        if options.start == "matched":
            wrong += _matched_problems(table)
        # A key of the section holds its default if anything inside it is invalid: what is wrong there is reported, and
        # checks would be about the default.
        defaults = {".".join(problem.key.partition("[")[0].split(".")[:2]) for problem in problems}
        problems += [problem for problem in wrong if not is_within(problem.key, defaults)]
        return {"table": table, "options": options, "base": base}, problems

    def warnings(self) -> list[str]:
        """Return warnings of settings in the initial case, and of variables, that are probably unintended."""
        return [*self.base.warnings(), *variable_warnings(self.options.variables, self.base)]

    def to_toml(self) -> str:
        """Return the case as TOML; reading it back gives the same search."""
        section = self.options.model_dump(exclude_none=True)
        return tomli_w.dumps({"name": self.name} | self.table | {"optimise": section})

    def runs(self) -> list[CaseFile]:
        """Return the case to begin with, of which designs are variations."""
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
        return (self.base.model().chain.sites.cells + 1).tolist()

    @cached_property
    def space(self) -> SearchSpace:
        """The variables of the search with their ranges."""
        return search_space(self.options.variables, self.table, self.base)

    def variables(self) -> list[Variable]:
        """Return variables of the search, in the order of the values of a design."""
        return self.space.variables

    def begin(self, clearance: Sequence[float] = ()) -> np.ndarray:
        """Return the values (variable) of the case to begin with, or with other clearances in m, within the bounds."""
        return self.space.begin(clearance)

    def design(self, values: np.ndarray) -> Case:
        """Return the case with ``values`` (variable); raises CaseError if it is impossible."""
        return case_of(self.space.table_at(values))

    def run(self, design: Case, amplitude: float, sample: int | None = None) -> Case:
        """Return a run of a ``design`` at an ``amplitude``, recorded whole, with scatter number ``sample`` if given."""
        changes = amplitude_changes(design, amplitude) | self._scatter(sample)
        return design.varied(name="design", without=("output",), output=design.output.of_points(), **changes)

    def responses(self, design: Case, sample: int | None = None) -> NfrcCase:
        """Return frequency responses of a ``design``, with the scatter number ``sample`` if given; raises CaseError."""
        scatter = self._scatter(sample)
        # To vary a case is to resolve it again, which a design without scatter does not need.
        if scatter:
            design = design.varied(**scatter)  # type: ignore[arg-type]  # changes by section
        return responses_of(design, self.table["nfrc"])

    def text_of(self, design: Case) -> str:
        """Return the ``design`` as TOML, with ``[nfrc]`` if frequency responses are measured."""
        if self.options.measures_responses:
            return self.responses(design).to_toml()
        return design.to_toml()

    def _scatter(self, sample: int | None) -> dict[str, Table]:
        """Return the changes of a design that bring in the scatter number ``sample``, if any."""
        disorder = self.table.get("disorder")
        if sample is None or disorder is None:
            return {}
        # The seed depends on the sample alone, so that all designs meet the same scatter.
        return {"disorder": disorder | {"seed": disorder.get("seed", 0) + sample}}


def responses_of(design: Case, nfrc: Any) -> NfrcCase:
    """Return the frequency responses of a ``design`` by the section ``nfrc``; raises CaseError."""
    table = design.model_dump(by_alias=True, exclude_none=True, include={*Case.model_fields})
    return NfrcCase.from_table(table | {"nfrc": nfrc})


def _problems(options: OptimiseTable, base: Case, given: Table, responses: NfrcCase | None) -> Iterator[Problem]:
    """Yield problems between the keys of the section and the case to begin with."""
    bounds = options.variables
    sites = base.model().chain.sites
    if not sites and (bounds.clearance or bounds.profile or bounds.sites):
        yield Problem("contacts.sites", base.contacts.sites, "no sites, whose clearances or cells could vary")
    yield from variable_problems(bounds, given, base)
    yield from _amplitude_problems(options)

    if options.samples > 1 and "disorder" not in given:
        yield Problem("optimise.samples", options.samples, "there is no [disorder] from which to draw samples")
    if options.start == "matched" and not (bounds.clearance or bounds.profile):
        yield Problem("optimise.start", options.start, "the start matches clearances: let clearance or profile vary")
    if options.curve and not has_free_amplitude(base):
        yield Problem("optimise.curve", options.curve, f"{FILE_AMPLITUDE}; remove it")
    for at, table in options.measured_at:
        yield from measured_problems(table, at, base, bounds.varies_cell, responses)
    for number, constraint in enumerate(options.constraint or [], 1):
        at = f"optimise.constraint[{number}]"
        low = constraint.at_least
        high = constraint.at_most
        if low is None and high is None:
            yield Problem(at, None, "has no bound; give at_least, at_most or both")
        elif low is not None and high is not None and low > high:
            yield Problem(f"{at}.at_least", low, f"is above at_most = {high:g}")


def _amplitude_problems(options: OptimiseTable) -> Iterator[Problem]:
    """Yield problems with amplitudes that are given where the amplitude itself varies."""
    varying = [key for key in options.variables.keys_of_case() if key in AMPLITUDES]
    for at, table in options.measured_at:
        if varying and table.amplitudes:
            remedy = f"would take the place of {varying[0]}, which varies; remove one of them"
            yield Problem(f"{at}.amplitudes", table.amplitudes, remedy)


def _matched_problems(table: Table) -> Iterator[Problem]:
    """Yield problems with clearances to be matched by a scattering law: of a case that has none, or several."""
    without_scatter = {key: section for key, section in table.items() if key != "disorder"}
    try:
        law = LawCase.from_table(without_scatter | {"name": "law"})
    except CaseError as error:
        for problem in error.problems:
            remedy = f"there is no scattering law by which clearances could be matched: {problem}"
            yield Problem("optimise.start", "matched", remedy)
        return
    # One law is computed, for the cell's own pair, by whose linear motion all clearances are set.
    if len(law.kinds.kinds) > 1 or law.model().chain.has_own_pairs:
        remedy = "clearances are matched by the scattering law of one site, and these sites differ; begin with the case"
        yield Problem("optimise.start", "matched", remedy)
