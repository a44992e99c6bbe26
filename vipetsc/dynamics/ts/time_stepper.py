"""PETSc's time stepper for a lattice: one trial of an explicit Runge-Kutta step at a time."""

import math
from typing import NamedTuple

from petsc4py import PETSc

from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.options import set_from_options
from vipetsc.dynamics.ts.right_hand_side import register
from vipetsc.records import Record

# Work and losses do not decide the step.
NO_TOLERANCE = 1e30
# PETSc wants some end of the integration; the loop of the engine has its own.
NO_END = 1e300


class StepOutcome(NamedTuple):
    """Whether a step was ``accepted``, and the length in s that the controller suggests for the next one."""

    accepted: bool
    suggestion: float


class TimeStepper:
    """Steps of ``model`` from its ``state``, tried one at a time; creation is collective, as is every step.

    ``ts`` is PETSc's time stepper with the options that the user gave. ``context`` (1,) is its right-hand side's
    ``CONTEXT``, which lives as long as ``ts``, and ``context_address`` where it is.
    """

    def __init__(self, model: Model, layout: Layout, state: PETSc.Vec, lattice: Record) -> None:
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
        # One trial a call: a rejected one is undone here, from the saved copy.
        ts.setMaxStepRejections(0)
        ts.setErrorIfStepFails(False)
        ts.setSolution(state)
        self.ts = ts
        self._state = state
        self._saved = state.duplicate()
        self.context = register(ts, lattice)
        self.context_address = int(self.context.ctypes.data)
        self._onset = self.context["onset"]

        # The step must depend neither on the lattice's length nor on the ranks: the largest error decides.
        set_from_options(ts, "ts_adapt_wnormtype", "infinity")

    def try_step(self, time: float, h: float, after_onset: bool) -> StepOutcome:
        """Try a step of ``h`` s from the state at ``time`` in s; a rejected one is undone.

        With ``after_onset``, at the onset of a contact, the step is one in the root of the time since: see ``ONSET``.
        """
        self._state.copy(self._saved)
        return self._try(time, h, after_onset)

    def repeat_step(self, time: float, h: float, after_onset: bool) -> StepOutcome:
        """Repeat ``try_step`` from the state with which the last step began."""
        self.undo_step()
        return self._try(time, h, after_onset)

    def _try(self, time: float, h: float, after_onset: bool) -> StepOutcome:
        ts = self.ts
        begin = time
        if after_onset:
            # PETSc's time is z, from 0 to h as well.
            begin = 0.0
            self._onset[0] = (time, h)
        ts.setTime(begin)
        ts.setTimeStep(h)
        ts.step()
        suggestion = ts.getTimeStep()
        if after_onset:
            self._onset[0] = (0.0, 0.0)
            # The last stage of a first-same-as-last pair is a rate by z.
            ts.restartStep()
        if math.isfinite(suggestion) and ts.getConvergedReason() >= 0:
            # After an onset it is a length in z. That is a cautious one in t: at the end of the step dt/dz = 2.
            return StepOutcome(accepted=True, suggestion=suggestion)

        self.undo_step()
        # The error of a trial that overflows is not finite, and no step follows from it: a much shorter one is tried.
        if not math.isfinite(suggestion):
            return StepOutcome(accepted=False, suggestion=0.1 * h)
        if after_onset:
            # From z = 0 on, a length in t is z^2/h.
            suggestion = suggestion * suggestion / h
        return StepOutcome(accepted=False, suggestion=suggestion)

    def undo_step(self) -> None:
        """Go back to the state that the last step began with."""
        self._saved.copy(self._state)
        self.ts.restartStep()

    def destroy(self) -> None:
        """Free PETSc's objects, but for the state."""
        self.ts.destroy()
        self._saved.destroy()
