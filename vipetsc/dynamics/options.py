"""PETSc options of a case: checked, and set while its engine is created."""

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from petsc4py import PETSc

from vipetsc.case import Case, CaseError, CaseFile, Problem
from vipetsc.case.schema import PetscTable, only_looks
from vipetsc.dynamics.native import petsc_library


def options_of(case: CaseFile | None) -> dict[str, str]:
    """The PETSc options of ``case`` by name."""
    table = getattr(case, "petsc", None)
    return table.model_dump() if table else {}


def with_database(case: Case) -> Case:
    """The ``case`` with the options of ``ts`` in PETSc's database, where a script has put them."""
    database = PETSc.Options().getAll()
    names = [name for name in database if name.startswith("ts_") and not only_looks(name)]
    given = {name: database[name] or "true" for name in names} | options_of(case)
    return case.model_copy(update={"petsc": PetscTable.model_validate(given)}) if given else case


@contextmanager
def petsc_options(options: Mapping[str, str]) -> Iterator[None]:
    """Set ``options`` within the block."""
    database = PETSc.Options()
    earlier = {name: value for name, value in database.getAll().items() if name in options}
    for name, value in options.items():
        database[name] = value
    # The database is the process's own: options of one case must not reach the engine of the next.
    try:
        yield
    finally:
        for name in options:
            database.delValue(name)
        for name, value in earlier.items():
            database[name] = value


def check_options(case: CaseFile | None) -> None:
    """Raise CaseError for options of ``case`` that Runge-Kutta stepping does not have, or whose value PETSc refuses."""
    options = options_of(case)
    if not options:
        return

    try:
        problems = _problems(options)
    except PETSc.Error:
        # PETSc does not say which option it refused: each is tried alone.
        problems = [(name, "PETSc refuses it") for name in options if _is_refused({name: options[name]})]
    if problems:
        raise CaseError([Problem(f"petsc.{name}", options[name], remedy) for name, remedy in problems])


def _is_refused(options: Mapping[str, str]) -> bool:
    try:
        _problems(options)
    except PETSc.Error:
        return True
    return False


def _problems(options: Mapping[str, str]) -> list[tuple[str, str]]:
    """Errors in ``options``, by name, after a time stepper has read them; raises PETSc.Error if it cannot."""
    ts = PETSc.TS().create(PETSc.COMM_SELF)
    ts.setType(PETSc.TS.Type.RK)
    problems = []
    with petsc_options(options):
        ts.setFromOptions()
        used = ctypes.c_int()
        for name in options:  # petsc4py 3.18 cannot say which were read
            petsc_library().PetscOptionsUsed(None, name.encode(), ctypes.byref(used))
            if not used.value:
                problems.append((name, "PETSc's time stepping has no such option"))
    if ts.getType() != PETSc.TS.Type.RK:
        problems.append(("ts_type", 'the lattice is stepped by "rk" alone; ts_rk_type names the method'))
    if not 0 < ts.getTimeStep() < float("inf"):
        problems.append(("ts_dt", "must be positive"))
    return problems
