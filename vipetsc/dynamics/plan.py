"""Plan of a run: its case, its model and the engine that simulates it, settled once, before any kernel is loaded."""

from typing import NamedTuple, Self

from vipetsc.case import Case, CaseError, CaseFile, Model
from vipetsc.case.section import Problem
from vipetsc.dynamics.cost import propagator_seconds, runge_kutta_seconds
from vipetsc.dynamics.propagator.step_choice import refusal

AUTO = "auto"
PROPAGATOR = "propagator"
TS = "ts"  # which suits every lattice
# Time in s that ts must save to be chosen where a case names no engine. Both estimates are rough, and runs that are
# over in less stay with the propagator.
NOTICED = 0.25
# Masses on a rank below which messages cost what further ranks save. As was measured, two ranks are a little slower
# than one at 1200 masses with ts, and as fast at 300 cells of four masses with the propagator.
FEW_MASSES = 750
# An engine so many times as fast is recommended.
MUCH_FASTER = 1.5


class EngineChoice(NamedTuple):
    """The ``name`` of an engine in case files; ``refused`` says why it is not the one that the case asks for, or None.

    A case that asks for none gets the propagator, if it can, and ts if that saves time.
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
        reason = f"rigid stops that share a mass, as in cell {cell}: blows pass from mass to mass at one instant, which"
        remedy = f"{reason} {TS} follows on one rank alone; start it without mpirun"
        if not plan.case.petsc_options and refusal(plan.model) is None:
            remedy = f"{remedy}, or use the {PROPAGATOR}"
        raise CaseError([Problem("contacts.sites", None, remedy)])


def choose_engine(case: Case, model: Model) -> EngineChoice:
    """Return the engine that ``case`` names, by default the faster one; ``ts`` where the propagator does not suit."""
    if case.time.engine == TS:
        return EngineChoice(TS, None)
    if case.petsc_options:
        return EngineChoice(TS, f"{PROPAGATOR} refused: PETSc options require ts")
    reason = refusal(model)
    if reason is not None:
        return EngineChoice(TS, f"{PROPAGATOR} refused: {reason}")
    # Wide cells, as of a strip, and many unlike ones take the propagator long to begin with. Rigid stops that share a
    # mass run by ts on one rank alone.
    is_free = case.time.engine == AUTO and not len(model.shared_masses)
    if is_free and propagator_seconds(model) > runge_kutta_seconds(model) + NOTICED:
        return EngineChoice(TS, f"{PROPAGATOR} would take longer, by its estimated cost")
    return EngineChoice(PROPAGATOR, None)


class Cost(NamedTuple):
    """CPU time in ``seconds`` that a run takes on each rank; ``faster`` says what would take less, if anything."""

    seconds: float
    faster: str


def estimate(plan: RunPlan, ranks: int = 1) -> Cost:
    """Return cost of the run that a ``plan`` says, on so many ranks; every site is assumed to meet the drive's wave."""
    model = plan.model
    seconds = runge_kutta_seconds(model)
    faster = []
    if not plan.case.petsc and refusal(model) is None:
        by_propagator = propagator_seconds(model)
        if plan.engine.name == PROPAGATOR:
            seconds = by_propagator
        elif seconds >= MUCH_FASTER * by_propagator:
            ratio = seconds / by_propagator
            faster.append(f'time.engine = "propagator" would be about {ratio:.0f} times faster')

    if ranks > 1 and model.chain.cells * model.chain.cell.dofs < FEW_MASSES * ranks:
        faster.append(f"one rank would be as fast: in so short a lattice messages cost what {ranks} ranks save")
    else:
        seconds /= ranks
    return Cost(seconds, "; ".join(faster))
