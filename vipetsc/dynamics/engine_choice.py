"""Choice of the engine that simulates a case, made before any kernel is loaded."""

from typing import NamedTuple

from vipetsc.case import Case, Model
from vipetsc.dynamics.options import options_of
from vipetsc.dynamics.propagator.step_choice import refusal

PROPAGATOR = "propagator"
TS = "ts"  # which suits every lattice


class EngineChoice(NamedTuple):
    """The ``name`` of an engine in case files; ``refused`` says why it is not the one that the case asks for, or None.

    A case that asks for none gets the propagator, if it can.
    """

    name: str
    refused: str | None


def choose_engine(case: Case, model: Model) -> EngineChoice:
    """The engine that ``case`` names, by default the propagator; ``ts`` where that does not suit its ``model``."""
    if case.time.engine == TS:
        return EngineChoice(TS, None)
    if options_of(case):
        return EngineChoice(TS, f"{PROPAGATOR} refused: PETSc options require ts")
    reason = refusal(model)
    if reason is not None:
        return EngineChoice(TS, f"{PROPAGATOR} refused: {reason}")
    return EngineChoice(PROPAGATOR, None)
