"""The verbs ``analyse`` and ``export``: measures of finished runs, and results in the formats of other programs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from vipetsc.cli.arguments import SET, argument
from vipetsc.cli.messages import echo_paths
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.io.errors import is_of_file_system
from vipetsc.io.folder import FolderError
from vipetsc.io.lock import locked
from vipetsc.parallel import StopRequest, on_root

if TYPE_CHECKING:
    from mpi4py import MPI


def analyse(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Measure finished runs again; of a sweep, those whose fields were kept, and its ensemble."""
    from vipetsc.studies.reanalysis import reanalyse_folders

    with locked(comm, *existing_folders(options.path, comm)):
        echo_paths(comm, reanalyse_folders(options.path, comm, options.set))
    return DONE


def export(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Write ``run.xdmf`` into the folder of a run, and curves of runs, sweeps, branches and searches as CSV."""
    with locked(comm, *existing_folders(options.path, comm)):
        for path in options.path:
            echo_paths(comm, on_root(comm, lambda path=path: write_exports(path)))  # type: ignore[misc]
    return DONE


def existing_folders(paths: list[Path], comm: "MPI.Comm") -> list[Path]:
    """Return the folders to lock for ``paths``: each path itself, or the folder of a file."""
    # A missing path has no folder to lock; the verb refuses it with a reason.
    return on_root(comm, lambda: [_folder_of(path) for path in paths if path.exists()])


def _folder_of(path: Path) -> Path:
    """Return the ``path`` itself if it is a folder, else the folder of the file."""
    if path.is_dir():
        return path
    return path.parent


def write_exports(path: Path) -> list[Path]:
    """Export the results in ``path``, a file or folder of results; returns the files written.

    Raises FolderError for results that cannot be read, and for a path without any.
    """
    from vipetsc.io.export import write_curves, write_xdmf
    from vipetsc.io.read import open_results

    folder = _folder_of(path)
    sources = [path]
    if path.is_dir():
        # Folders of branches alone have several files of curves; in another folder `write_curves` finds the file.
        sources = sorted(path.glob("branch-*.h5")) or [path]
    written = []
    try:
        # A file without results that lies beside a run is refused before the mesh of the run is written.
        if not path.is_dir():
            open_results(path).close()
        if (folder / "run.h5").exists():
            mesh = write_xdmf(folder)
            if mesh:
                written.append(mesh)
        for source in sources:
            written += write_curves(source)
    # OSError: a file that was cut off or is no HDF5. ValueError: a file of another program.
    except (OSError, ValueError) as error:
        if is_of_file_system(error):
            raise
        raise FolderError(str(error)) from error
    return written


ANALYSE = PlainVerb(
    name="analyse",
    text="measure finished runs again, from their files",
    example="analyse runs/four-band --set analysis.band_stride=1",
    arguments=(
        argument("path", type=Path, nargs="+", metavar="PATH", help="folder of a run or of a sweep, or a run.h5"),
        SET,
    ),
    function=analyse,
)

EXPORT = PlainVerb(
    name="export",
    text="write the curves of any results as CSV, and XDMF for ParaView next to a run",
    example="export runs/four-band",
    arguments=(argument("path", type=Path, nargs="+", metavar="PATH", help="folder or file of results"),),
    function=export,
)
