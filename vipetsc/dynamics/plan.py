"""Plan of a run: its case, its model and the engine that simulates it, settled once, before any kernel is loaded."""

from typing import NamedTuple, Self

from vipetsc.case import Case, CaseError, CaseFile, Model
from vipetsc.case.section import Problem
from vipetsc.dynamics.propagator.step_choice import refusal

PROPAGATOR = "propagator"
TS = "ts"  # which suits every lattice


class EngineChoice(NamedTuple):
    """The ``name`` of an engine in case files; ``refused`` says why it is not the one that the case asks for, or None.

    A case that asks for none gets the propagator, if it can.
    """

    name: str
    refused: str | None


class RunPlan(NamedTuple):
    """A run of ``case``: its ``model``, the choice of its ``engine``, and ``warnings`` that its result repeats.

    What a run needs to know of its case is asked for here, once. A run of many, whose result nobody reads, may have a
    model of its own and no warnings.
    """

    case: Case
    model: Model
    engine: EngineChoice
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, case: Case) -> Self:
        """Return the plan of a run of ``case``; raises CaseError for PETSc options that there are not."""
        check_petsc_options(case)
        model = case.model()
        engine = choose_engine(case, model)
        warnings = case.warnings()
        if case.time.engine == PROPAGATOR and engine.refused:
            warnings.append(f"time.engine = {PROPAGATOR!r} is not used: {engine.refused}; {engine.name} simulates it")
        return cls(case, model, engine, tuple(warnings))


def check_petsc_options(case: CaseFile) -> None:
    """Raise CaseError for PETSc options of ``case`` that there are not, or whose value PETSc refuses."""
    # PETSc takes a quarter of a second to start: cases without options are checked without it.
    if case.petsc_options:
        from vipetsc.dynamics.options import check_options

        check_options(case)


def check_ranks(plan: RunPlan, ranks: int) -> None:
    """Raise CaseError for a ``plan`` that only one of several ``ranks`` can carry out."""
    # Blows at one instant pass from mass to mass, and reactions depend on one another, across all ranks.
    if ranks > 1 and plan.engine.name == TS and plan.model.has_rigid_sites and len(plan.model.shared_masses):
        mass = int(plan.model.shared_masses[0])
        cell = mass // plan.model.chain.cell.dofs + 1
        remedy = f"rigid stops that share a mass, as in cell {cell}, run by {TS} on one rank: start it without mpirun"
        raise CaseError([Problem("contacts.sites", None, remedy)])


def choose_engine(case: Case, model: Model) -> EngineChoice:
    """Return the engine that ``case`` names, by default the propagator; ``ts`` where that does not suit ``model``."""
    if case.time.engine == TS:
        return EngineChoice(TS, None)
    if case.petsc_options:
        return EngineChoice(TS, f"{PROPAGATOR} refused: PETSc options require ts")
    reason = refusal(model)
    if reason is not None:
        return EngineChoice(TS, f"{PROPAGATOR} refused: {reason}")
    return EngineChoice(PROPAGATOR, None)
