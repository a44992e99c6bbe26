"""PETSc options of a case: checked, and set for as long as its run lasts."""

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from petsc4py import PETSc

import numpy as np

from vipetsc.case import Case, CaseError, CaseFile, Problem
from vipetsc.case.schema import PetscTable, only_looks
from vipetsc.dynamics.ts.right_hand_side import petsc_library


def with_database(case: Case) -> Case:
    """``case`` with the options of ``ts`` that stand in PETSc's database, where a script has put them."""
    found: dict[str, str] = {
        name: value or "" for name, value in PETSc.Options().getAll().items() if name.startswith("ts_")
    }
    given = {name: value for name, value in found.items() if not only_looks(name)} | options_of(case)
    return case.model_copy(update={"petsc": PetscTable.model_validate(given)}) if given else case


def options_of(case: CaseFile | None) -> dict[str, str]:
    """The PETSc options of ``case`` by name."""
    table = getattr(case, "petsc", None)
    return table.model_dump() if table else {}


@contextmanager
def petsc_options(options: Mapping[str, str]) -> Iterator[None]:
    """Set ``options`` within the block."""
    database = PETSc.Options()
    earlier = {name: database.getString(name, "") for name in options if database.hasName(name)}
    try:
        for name, value in options.items():
            database[name] = value
        yield
    finally:
        for name in options:
            database.delValue(name)
        for name, value in earlier.items():
            database[name] = value


def check_options(case: CaseFile | None) -> None:
    """Raise CaseError for options of ``case`` that Runge-Kutta stepping does not know, or whose value PETSc refuses."""
    if not (options := options_of(case)):
        return
    problems = [] if _taken(options) else [(n, "PETSc refuses it") for n in options if not _taken({n: options[n]})]
    if not problems:
        with petsc_options(options):
            kind, step = _runge_kutta()
            problems = [(name, "PETSc's time stepping has no such option") for name in options if not _used(name)]
        if kind != PETSc.TS.Type.RK:
            problems.append(("ts_type", 'the lattice is stepped by "rk" alone; ts_rk_type names the method'))
        if not 0 < step < np.inf:
            problems.append(("ts_dt", "must be positive"))
    if problems:
        raise CaseError([Problem(f"petsc.{name}", options[name], remedy) for name, remedy in problems])


def _taken(options: Mapping[str, str]) -> bool:
    """Whether PETSc takes the values of ``options``."""
    with petsc_options(options):
        try:
            _runge_kutta()
        except PETSc.Error:
            return False
    return True


def _runge_kutta() -> tuple[str, float]:
    """Type and first step in s of a time stepper that has read its options."""
    ts = PETSc.TS().create(PETSc.COMM_SELF)
    try:
        ts.setType(PETSc.TS.Type.RK)
        ts.setFromOptions()
        return ts.getType(), ts.getTimeStep()
    finally:
        ts.destroy()


def _used(name: str) -> bool:
    """Whether some PETSc object has read the option ``name``; petsc4py 3.18 cannot say."""
    used = ctypes.c_int()
    petsc_library().PetscOptionsUsed(None, name.encode(), ctypes.byref(used))
    return bool(used.value)
