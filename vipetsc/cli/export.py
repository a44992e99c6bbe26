"""The verb ``export``: results in the forms of other programs."""

import argparse
from pathlib import Path

from mpi4py import MPI

from vipetsc.cli.verbs import DONE, echo_paths
from vipetsc.io.folder import FolderError
from vipetsc.io.lock import locked
from vipetsc.parallel import StopRequest, on_root


def export(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """``run.xdmf`` beside a run, and the curves of runs, sweeps, branches and searches as CSV files."""
    from vipetsc.io.export import write_curves, write_xdmf

    def write(path: Path) -> list[Path]:
        folder = path if path.is_dir() else path.parent
        try:
            curves = [path, *sorted(path.glob("branch-*.h5"))] if path.is_dir() else [path]
            mesh = write_xdmf(folder) if (folder / "run.h5").exists() else None
            return [p for p in (mesh,) if p] + [p for source in (curves[1:] or curves) for p in write_curves(source)]
        except (OSError, ValueError) as error:
            raise FolderError(str(error)) from error

    folders = on_root(comm, lambda: [path if path.is_dir() else path.parent for path in options.path if path.exists()])
    with locked(comm, *folders):
        for path in options.path:
            echo_paths(comm, on_root(comm, lambda path=path: write(path)))  # type: ignore[misc]
    return DONE
