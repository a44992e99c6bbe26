"""The measures of runs already made, once more: one run, or all of a sweep whose fields were kept."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

from vipetsc.case import Sweep
from vipetsc.io.folder import FolderError
from vipetsc.io.run_file import RunFile
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.analysis import analyse
from vipetsc.studies.members import LinearWave, Members
from vipetsc.studies.sweep import conclude


def analyse_again(paths: list[Path], comm: MPI.Comm) -> list[Path]:
    """Measure the runs in ``paths`` (folders of runs or sweeps, or ``run.h5``); returns the files written.

    The runs are shared over the ranks of ``comm``. Members of a sweep that kept no fields stay as they are; the
    sweep's ensemble is put together anew.

    Raises
    ------
    FolderError
        If a path holds neither runs nor a sweep; nothing is written then.
    """
    runs = on_root(comm, lambda: [folder for path in paths for folder in _runs(path)])
    measured: list[Path] = []
    for folder in runs[comm.rank :: comm.size]:
        with RunFile(folder / "run.h5") as run:
            if "velocity" in run.file or not (folder.parent / "index.json").exists():
                analyse(run, folder / "analysis.h5", arrival=_arrival(folder, run))
                measured.append(folder / "analysis.h5")
    written = sorted(path for share in comm.allgather(measured) for path in share)
    for folder in paths:
        if on_root(comm, (folder / "index.json").exists):
            written.append(on_root(comm, lambda folder=folder: _reassemble(folder)))
    return written


def _runs(path: Path) -> list[Path]:
    folder = path.parent if path.name == "run.h5" else path
    sweep = (folder / "index.json").exists()
    found = [run.parent for run in sorted(folder.glob("*/run.h5"))] if sweep else [folder]
    if not sweep and not (folder / "run.h5").exists():
        raise FolderError(f"{path}: holds no run.h5; the folder of a finished run or sweep is needed")
    for one in found:
        try:
            with RunFile(one / "run.h5"):
                pass
        except (OSError, ValueError, KeyError) as error:
            raise FolderError(f"{one / 'run.h5'}: is not a run of vipetsc ({error})") from None
    return found


def _arrival(folder: Path, run: RunFile) -> float | None:
    """The wave's arrival at the first site as the run's sweep knows it, None outside a sweep."""
    shop = Members(folder.parent, None, MPI.COMM_SELF, StopRequest())
    wave = shop.linear_folder(run.case) / "wave.h5"
    return shop.arrival(run.case, LinearWave.read(wave)) if wave.exists() else None


def _reassemble(folder: Path) -> Path:
    plan = Sweep.load(folder / "case.toml")
    shop = Members(folder, plan.options, MPI.COMM_SELF, StopRequest())
    outcomes = conclude(plan, plan.members(), shop, {})
    if not all(outcomes):
        raise FolderError(f"{folder}: the sweep is not finished; the verb sweep goes on with it")
    return folder / "ensemble.h5"
