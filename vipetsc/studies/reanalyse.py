"""The measures of runs already made, once more: one run, or all of a sweep whose fields were kept."""

from pathlib import Path

from mpi4py import MPI

import vipetsc
from vipetsc.case import Case, Sweep
from vipetsc.io.folder import FolderError
from vipetsc.io.netcdf import open_netcdf, write_netcdf
from vipetsc.io.read import open_run
from vipetsc.parallel import on_every_rank, on_root
from vipetsc.studies.analysis import analyse
from vipetsc.studies.members import MemberStore, arrival_at
from vipetsc.studies.sweep import conclude


def reanalyse_folders(paths: list[Path], comm: MPI.Comm) -> list[Path]:
    """Measure the runs in ``paths`` (folders of runs or sweeps, or ``run.h5``); returns the files written.

    The runs are shared over the ranks of ``comm``. Members of a sweep that kept no fields stay as they are; the
    sweep's ensemble is put together anew.

    Raises FolderError if a path holds neither runs nor a sweep; nothing is written then.
    """
    runs = on_root(comm, lambda: [folder for path in paths for folder in _run_folders(path)])

    def has_fields(folder: Path) -> bool:
        with open_run(folder / "run.h5") as run:
            return "velocity" in run or not (folder.parent / "index.json").exists()

    share = runs[comm.rank :: comm.size]
    measured = on_every_rank(comm, lambda: [measure_run(folder) for folder in share if has_fields(folder)])
    written = sorted(path for paths in comm.allgather(measured) for path in paths)

    def reassemble(folder: Path) -> Path:
        plan = Sweep.load(folder / "case.toml")
        if not all(conclude(plan, plan.members(), MemberStore(folder, plan.options), {})):
            raise FolderError(f"{folder}: the sweep is not finished; the verb sweep goes on with it")
        return folder / "ensemble.h5"

    return written + on_root(comm, lambda: [reassemble(path) for path in paths if (path / "index.json").exists()])


def measure_run(folder: Path) -> Path:
    """Write ``folder/analysis.h5`` and return its path; a sweep knows when the wave arrives. Raises as ``open_run``."""
    with open_run(folder / "run.h5") as run:
        case = Case.of(run)
        wave = MemberStore(folder.parent).wave(case)
        write_netcdf(folder / "analysis.h5", analyse(run, arrival=None if wave is None else arrival_at(wave, case)))
    return folder / "analysis.h5"


def is_measured(folder: Path) -> bool:
    """Whether ``folder/analysis.h5`` was measured by this version from ``run.h5`` as it is; raises as ``open_run``."""
    with open_run(folder / "run.h5") as run:
        if not (folder / "analysis.h5").exists():
            return False
        expected = {key: run.attrs.get(key) for key in ("case", "status")} | {"vipetsc_version": vipetsc.__version__}
        with open_netcdf(folder / "analysis.h5", "analysis") as analysis:
            return all(analysis.attrs.get(key) == value for key, value in expected.items())


def _run_folders(path: Path) -> list[Path]:
    """The folders of the runs in ``path``, every one checked; raises FolderError."""
    folder = path.parent if path.name == "run.h5" else path
    sweep = (folder / "index.json").exists()
    folders = [run.parent for run in sorted(folder.glob("*/run.h5"))] if sweep else [folder]
    if not sweep and not (folder / "run.h5").exists():
        raise FolderError(f"{path}: holds no run.h5; the folder of a finished run or sweep is needed")
    for one in folders:
        try:
            open_run(one / "run.h5").close()
        except (OSError, ValueError, KeyError) as error:
            raise FolderError(f"{one / 'run.h5'}: is not a run of vipetsc ({error})") from None
    return folders
