"""PETSc's time stepper for a lattice: one trial of an explicit Runge-Kutta step at a time."""

from petsc4py import PETSc

from vipetsc.case import Model
from vipetsc.dynamics.lattice_record import LatticeRecord
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts.right_hand_side import register

# Work and losses do not decide the step.
NO_TOLERANCE = 1e30
# PETSc wants some end of the integration; the loop of the engine has its own.
NO_END = 1e300


def create_time_stepper(model: Model, layout: Layout, state: PETSc.Vec, lattice: LatticeRecord) -> PETSc.TS:
    """The time stepper of ``model`` on its ``state``, with the options that the user gave; collective."""
    tolerances = state.duplicate()
    half = layout.dofs * layout.owned
    tolerances.array[:half], tolerances.array[half : 2 * half] = model.atol
    tolerances.array[2 * half :] = NO_TOLERANCE

    ts = PETSc.TS().create(layout.comm)
    ts.setProblemType(PETSc.TS.ProblemType.NONLINEAR)
    ts.setType(PETSc.TS.Type.RK)
    ts.setRKType(model.method)
    ts.setTolerances(rtol=model.rtol, atol=tolerances)
    ts.setMaxTime(NO_END)
    ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
    # One trial a call: the engine undoes a rejected one, from its saved copy.
    ts.setMaxStepRejections(0)
    ts.setErrorIfStepFails(False)
    ts.setSolution(state)
    register(ts, lattice)

    # The step must depend neither on the lattice's length nor on the ranks: the largest error decides. PETSc takes the
    # norm from its options alone, where it must not stay for the next time stepper of the process.
    options = PETSc.Options()
    norm = "ts_adapt_wnormtype"
    if options.hasName(norm):
        ts.setFromOptions()
    else:
        options[norm] = "infinity"
        ts.setFromOptions()
        options.delValue(norm)
    return ts
