"""Entry point: ``python -m vipetsc VERB``, on one process or under ``mpirun -n N``; PETSc options follow ``--``."""

import io
import logging
import os
import sys
from importlib.util import find_spec
from pathlib import Path

from vipetsc.process import end_on_request, launched_rank

# Libraries that must be built for the machine's MPI, so that setting up the package does not install them.
BUILT_FOR_MPI = "mpi4py", "petsc4py", "h5py"
# What one process answers: verbs that only look at a case or at the program, and its version.
LOOKING = "completion", "examples", "manual", "schema", "validate", "--version"


def main(arguments: list[str] | None = None) -> int:
    """Run one verb on all ranks; returns the exit code: 0 done, 2 bad input, 75 stopped on request, 1 failed."""
    # Before modules are loaded, which takes a second or more.
    end_on_request()
    _open_closed_streams()

    # One thread per rank: further threads would compete with the other ranks for the cores.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    # Pictures go into files. A notebook names a backend for its own windows, which may not be installed here.
    os.environ["MPLBACKEND"] = "agg"
    logging.basicConfig(format="%(message)s")
    logging.getLogger("vipetsc").setLevel(logging.INFO)

    # Looked for rather than imported: PETSc takes its options from the first import that starts it.
    if missing := [name for name in BUILT_FOR_MPI if find_spec(name) is None]:
        remedy = (
            "on Debian: apt install python3-petsc4py python3-h5py, in an environment with --system-site-packages;"
            " without root or Debian: scripts/recipes/pip in a clone creates an environment"
        )
        logging.getLogger("vipetsc").critical("vipetsc: %s not installed; %s", " and ".join(missing), remedy)
        return 1

    arguments = sys.argv[1:] if arguments is None else arguments
    end = arguments.index("--") if "--" in arguments else len(arguments)
    needs_ranks = not only_looks_at(arguments[:end]) or launched_rank() is not None or gives_petsc_options(arguments)
    if needs_ranks:
        import petsc4py

        # PETSc's handlers of signals would end the process at once; ours end a run at its next step, with a checkpoint.
        petsc4py.init([sys.argv[0], "-no_signal_handler", *arguments[end + 1 :]])

    try:
        from vipetsc.parallel import ALONE, install_abort_hook

        ranks = ALONE
        if needs_ranks:
            from mpi4py import MPI

            ranks = MPI.COMM_WORLD
        # Before a rank can fail: one that raises alone would leave the others waiting for ever.
        install_abort_hook(ranks)

        from vipetsc.cli.main import main as run_verb
    except ImportError as error:
        # One of the package's own modules that cannot be imported is a defect, and wants its traceback.
        if (error.name or "").startswith("vipetsc"):
            raise
        remedy = "it is missing or incompatible with the others; the chapter install of the manual lists what is needed"
        logging.getLogger("vipetsc").critical("vipetsc: %s; %s", error, remedy)
        return 2

    options = {}
    if needs_ranks:
        options = options_of_results()
    return run_verb(arguments[:end], options, ranks)


def only_looks_at(arguments: list[str]) -> bool:
    """Return whether a verb only looks at a case or the program, or help is asked for: one process, no MPI.

    To start MPI and PETSc takes half a second.
    """
    asks_for_help = "-h" in arguments or "--help" in arguments
    return asks_for_help or (bool(arguments) and arguments[0] in LOOKING)


def gives_petsc_options(arguments: list[str]) -> bool:
    """Return whether options for PETSc are given: behind ``--``, in the environment or in a file that PETSc reads."""
    files = Path.home() / ".petscrc", Path(".petscrc"), Path("petscrc")
    return "--" in arguments or "PETSC_OPTIONS" in os.environ or any(file.exists() for file in files)


def options_of_results() -> dict[str, str]:
    """Take from PETSc's database the options that a result may depend on: they become part of the case."""
    from petsc4py import PETSc

    from vipetsc.case.schema import only_looks

    database = PETSc.Options()
    options = {name: value or "true" for name, value in database.getAll().items() if not only_looks(name)}
    for name in options:
        database.delValue(name)
    return options


def _open_closed_streams() -> None:
    """Open standard streams that the caller has closed, so that no file of results gets the number of one of them."""
    for name, mode in ("stdin", "r"), ("stdout", "w"), ("stderr", "w"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115

    # Characters that the terminal's encoding lacks are printed as escapes, as on stderr.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


if __name__ == "__main__":
    sys.exit(main())
