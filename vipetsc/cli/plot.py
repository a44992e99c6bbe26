"""Pictures of what a folder holds, drawn again from its files over all ranks."""

from collections.abc import Sequence
from pathlib import Path

from mpi4py import MPI

from vipetsc.io.folder import FolderError
from vipetsc.io.read import outdated
from vipetsc.parallel import on_every_rank, on_root

_NOT_OURS = {
    "design": "design.h5: is not a search",
    "optimum": "optimum.h5: is not a search",
    "law": "law.h5: is not a law",
    "prediction": "prediction.h5: is not a prediction",
    "branches": "branch-*.h5: is not a branch",
}


def source_of(paths: Sequence[Path]) -> tuple[str, Sequence[Path]]:
    """Which of runs, sweeps, branches or a search ``paths`` hold, and the folders where files were named.

    Raises FolderError for folders that cannot share a page.
    """
    if all(any(path.glob("branch-*.h5")) and not (path / "run.h5").exists() for path in paths):
        return "branches", paths
    if (paths[0] / "ensemble.h5").exists():
        return "sweep", paths
    if len(paths) > 1:
        raise FolderError(f"{' '.join(map(str, paths))}: only sweeps and folders of branches can share a page")
    (path,) = paths
    kinds = "design", "optimum", "law", "prediction"
    folder = path.parent if path.name in ("run.h5", *(f"{kind}.h5" for kind in kinds)) else path
    return next((kind for kind in kinds if (folder / f"{kind}.h5").exists()), "run"), [folder]


def draw_source(
    source: str,
    folders: Sequence[Path],
    comm: MPI.Comm,
    names: list[str] | None = None,
    formats: tuple[str, ...] = ("png",),
    afresh: bool = True,
) -> list[Path]:
    """Draw what ``folders`` hold as `vipetsc.figures.registry.draw`, measured first where that is missing or older.

    ``names`` are figures of the kind ``source``; unless ``afresh``, those that are newer than the files they show stay.
    Returns the files written, on rank 0. Raises FolderError for folders
    that hold nothing to draw, and for a figure that does not exist.
    """
    from vipetsc.figures.registry import draw

    def draw_share() -> list[Path]:
        try:
            return draw(source, folders, names, formats, rank=comm.rank, ranks=comm.size, newest=newest)
        except (OSError, KeyError, ValueError) as error:
            if source not in _NOT_OURS:
                raise
            raise FolderError(f"{folders[0] / _NOT_OURS[source]} of vipetsc ({error})") from None

    on_root(comm, lambda: prepare(source, folders, names))
    newest = None if afresh else on_root(comm, lambda: max(p.stat().st_mtime for f in folders for p in f.glob("*.h5")))
    drawn = on_every_rank(comm, draw_share)
    return sorted(path for paths in comm.gather(drawn) or [] for path in paths)


def prepare(source: str, folders: Sequence[Path], names: list[str] | None) -> None:
    """Check what is to be drawn, and measure what is missing or older than its run; on one rank."""
    from vipetsc.figures.registry import figure_names

    try:
        figure_names(source, names)
    except KeyError as error:
        raise FolderError(f"--fig: {error.args[0]}") from None
    if source == "sweep":
        from vipetsc.studies.backbone import relate_folders

        for folder in folders:
            if reason := outdated(folder):
                raise FolderError(reason)
            if not (folder / "ensemble.h5").exists() and not any(folder.glob("branch-*.h5")):
                raise FolderError(f"{folder}: holds neither a finished sweep nor branches")
        relate_folders(folders)
    elif source == "run":
        from vipetsc.studies.reanalysis import is_measured, measure_run

        run = folders[0] / "run.h5"
        if not run.exists():
            raise FolderError(f"{folders[0]}: holds no run.h5; a finished run's folder is needed")
        try:
            measured = is_measured(folders[0])
        except (OSError, ValueError, KeyError) as error:
            raise FolderError(f"{run}: is not a run of vipetsc ({error})") from None
        if not measured:
            measure_run(folders[0])
