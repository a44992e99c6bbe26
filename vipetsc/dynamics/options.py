"""PETSc options of a case: checked, and set while its engine is created."""

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from petsc4py import PETSc

from vipetsc.case import Case, CaseError, CaseFile, Problem
from vipetsc.case.schema import RENAMED_OPTIONS, PetscTable, only_looks
from vipetsc.dynamics.petsc_library import petsc_library

# The version of PETSc since which options of time stepping have other names (``RENAMED_OPTIONS``).
RENAMING_VERSION = (3, 25)


def with_database(case: Case) -> Case:
    """Return the ``case`` with the options of ``ts`` in PETSc's database, where a script has put them."""
    database = PETSc.Options().getAll()
    names = [name for name in database if name.startswith("ts_") and not only_looks(name)]
    given = {name: database[name] or "true" for name in names} | case.petsc_options
    if not given:
        return case
    return case.model_copy(update={"petsc": PetscTable.model_validate(given)})


def name_in_petsc(name: str, version: tuple[int, ...] | None = None) -> str:
    """Return the name that the option ``name`` of a case has in PETSc, of this ``version`` or as it is installed."""
    version = version or PETSc.Sys.getVersion()
    if version < RENAMING_VERSION:
        return name
    later = {old: new for new, old in RENAMED_OPTIONS.items()}
    return later.get(name, name)


def given_first_step(default: float) -> float:
    """Return first step of ``ts`` in PETSc's database; must be read before ``setFromOptions``, which removes a name."""
    database = PETSc.Options()
    for name in ("ts_time_step", "ts_dt"):
        if database.hasName(name):
            return database.getReal(name)
    return default


def set_from_options(solver: PETSc.TS | PETSc.SNES, name: str, default: str) -> None:
    """Let a ``solver`` take its options from PETSc's database, with a ``default`` for the option ``name``.

    It is for choices that PETSc takes from options alone. The default does not stay in the database, where the next
    solver of the process would find it, and files of results, which state the options given.
    """
    database = PETSc.Options()
    if database.hasName(name):
        solver.setFromOptions()
        return

    database[name] = default
    try:
        solver.setFromOptions()
    finally:
        database.delValue(name)


@contextmanager
def petsc_options(options: Mapping[str, str]) -> Iterator[None]:
    """Set ``options`` of a case within the block."""
    database = PETSc.Options()
    inside = {name_in_petsc(name): value for name, value in options.items()}
    # Under both names: where PETSc finds the earlier one it warns, and removes it.
    earlier = {name: value for name, value in database.getAll().items() if RENAMED_OPTIONS.get(name, name) in options}
    for name in earlier:
        database.delValue(name)
    for name, value in inside.items():
        database[name] = value
    # The database is the process's own: options of one case must not reach the engine of the next.
    try:
        yield
    finally:
        for name in inside:
            database.delValue(name)
        for name, value in earlier.items():
            database[name] = value


def check_options(case: CaseFile) -> None:
    """Raise CaseError for options of ``case`` that Runge-Kutta stepping does not have, or whose value PETSc refuses."""
    options = case.petsc_options
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
    """Return errors in ``options``, by name, after a time stepper has read them; raises PETSc.Error if it cannot."""
    ts = PETSc.TS().create(PETSc.COMM_SELF)
    ts.setType(PETSc.TS.Type.RK)
    # A case keeps the later name where it has both.
    problems = [
        (new, f"is another name of {old}: give only one") for new, old in RENAMED_OPTIONS.items() if new in options
    ]
    if problems:
        return problems

    # Not PETSc's to judge: some versions refuse NaN with a message of their own, others take it.
    if not _is_step(options.get("ts_dt", "1")):
        problems.append(("ts_dt", "must be positive"))
        options = {name: value for name, value in options.items() if name != "ts_dt"}

    with petsc_options(options):
        ts.setFromOptions()
        # PETSc's truth values have one byte or four, by its version.
        used = ctypes.c_int()
        for name in options:  # petsc4py 3.18 cannot say which were read
            petsc_library().PetscOptionsUsed(None, name_in_petsc(name).encode(), ctypes.byref(used))
            if not used.value:
                problems.append((name, "PETSc's time stepping has no such option"))
    if ts.getType() != PETSc.TS.Type.RK:
        problems.append(("ts_type", 'the lattice is stepped by "rk" alone; ts_rk_type names the method'))
    return problems


def _is_step(value: str) -> bool:
    """Return whether a time step may have the ``value``; a text that is no number is PETSc's to refuse."""
    try:
        return 0 < float(value) < float("inf")
    except ValueError:
        return True
