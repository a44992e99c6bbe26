"""Stages and events of PETSc's log, which ``-log_view`` shows: contexts, at 0.3 us each if nothing is logged.

Exchanges of cells are in PETSc's own events (VecScatterBegin, VecScatterEnd), steps of ``ts`` in TSStep.
"""

from petsc4py import PETSc

SET_UP, SAMPLES, ENDING = map(PETSc.Log.Stage, ("Set-up", "Samples", "Ending"))
PROPAGATOR, SEARCH, LANDING, RECORDER = map(PETSc.Log.Event, ("Propagator", "ContactSearch", "Landing", "Recorder"))
