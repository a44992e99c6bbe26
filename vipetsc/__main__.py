"""Entry point: ``python -m vipetsc VERB``, on one process or under ``mpirun -n N``; PETSc options follow ``--``."""

import io
import logging
import os
import sys
from importlib.util import find_spec

from vipetsc.process import end_on_request

# Libraries that must be built for the machine's MPI, so that setting up the package does not install them.
BUILT_FOR_MPI = "mpi4py", "petsc4py", "h5py"


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

    import petsc4py

    # PETSc's handlers of signals would end the process at once; ours end a run at its next step, with a checkpoint.
    petsc4py.init([sys.argv[0], "-no_signal_handler", *arguments[end + 1 :]])
    from petsc4py import PETSc

    try:
        from vipetsc.parallel import install_abort_hook

        # Before a rank can fail: one that raises alone would leave the others waiting for ever.
        install_abort_hook()

        from vipetsc.case.schema import only_looks
        from vipetsc.cli.main import main as run_verb
    except ImportError as error:
        # One of the package's own modules that cannot be imported is a defect, and wants its traceback.
        if (error.name or "").startswith("vipetsc"):
            raise
        remedy = "it is missing or incompatible with the others; the chapter install of the manual lists what is needed"
        logging.getLogger("vipetsc").critical("vipetsc: %s; %s", error, remedy)
        return 2

    # Options that a result may depend on become part of the case.
    database = PETSc.Options()
    options = {name: value or "true" for name, value in database.getAll().items() if not only_looks(name)}
    for name in options:
        database.delValue(name)

    return run_verb(arguments[:end], options)


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
