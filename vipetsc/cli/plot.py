"""Pictures of what a folder holds, drawn again from its files over all ranks."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from mpi4py import MPI

from vipetsc.io.store import FolderError
from vipetsc.parallel import on_root


def draw_folders(
    paths: Sequence[Path], names: list[str] | None, formats: tuple[str, ...], comm: MPI.Comm
) -> list[Path]:
    """Draw runs, sweeps, branches or a search, whichever ``paths`` hold; ``names`` are figures of that kind.

    Returns
    -------
    list of Path
        The files written, on rank 0; an empty list on the others.

    Raises
    ------
    FolderError
        For folders that hold nothing to draw, cannot share a page, or a figure that does not exist.
    """
    if all(any(path.glob("branch-*.h5")) and not (path / "run.h5").exists() for path in paths):
        return draw_branches(paths, formats, comm)
    if (paths[0] / "ensemble.h5").exists():
        return draw_sweeps(paths, names, formats, comm)
    if len(paths) > 1:
        raise FolderError(f"{' '.join(map(str, paths))}: only sweeps and folders of branches can share a page")
    (path,) = paths
    folder = path.parent if path.name in ("run.h5", "design.h5") else path
    if (folder / "design.h5").exists():
        return draw_search(folder, names, formats, comm)
    return draw_run(folder, names, formats, comm)


def draw_run(folder: Path, names: list[str] | None, formats: tuple[str, ...], comm: MPI.Comm) -> list[Path]:
    """Pictures of the run in ``folder``, measured first if its analysis is missing or older."""
    from vipetsc.figures import draw, run_figures
    from vipetsc.io.run_file import RunFile
    from vipetsc.studies.analysis import analyse

    def check() -> None:
        _known(names, run_figures)
        run, analysis = folder / "run.h5", folder / "analysis.h5"
        if not run.exists():
            raise FolderError(f"{folder}: holds no run.h5; a finished run's folder is needed")
        try:
            with RunFile(run):
                pass
        except (OSError, ValueError, KeyError) as error:
            raise FolderError(f"{run}: is not a run of vipetsc ({error})") from None
        if not analysis.exists() or analysis.stat().st_mtime < run.stat().st_mtime:
            analyse(run, analysis)

    on_root(comm, check)
    return _together(draw(folder, names, formats, (comm.rank, comm.size)), comm)


def draw_sweeps(
    folders: Sequence[Path], names: list[str] | None, formats: tuple[str, ...], comm: MPI.Comm
) -> list[Path]:
    """Pictures of sweeps, with branches beside them, into the first folder."""
    from vipetsc.figures import draw_study, study_figures
    from vipetsc.studies.backbone import relate_folders

    def check() -> None:
        _known(names, study_figures)
        for folder in folders:
            if not (folder / "ensemble.h5").exists() and not any(folder.glob("branch-*.h5")):
                raise FolderError(f"{folder}: holds neither a finished sweep nor branches")
        relate_folders(folders)

    on_root(comm, check)
    return _together(draw_study(folders, names, formats, (comm.rank, comm.size)), comm)


def draw_branches(folders: Sequence[Path], formats: tuple[str, ...], comm: MPI.Comm) -> list[Path]:
    """A picture of every branch in the first folder, beside the branches of that name in the others."""

    def draw() -> list[Path]:
        from vipetsc.figures import draw_backbone

        drawn = []
        stem = "branches" if len(folders) > 1 else "branch"
        for path in sorted(folders[0].glob("branch-*.h5")):
            together = [folder / path.name for folder in folders if (folder / path.name).exists()]
            target = folders[0] / "figures" / path.stem.replace("branch", stem, 1)
            drawn += [draw_backbone(together, target.with_suffix(f".{kind}")) for kind in formats]
        return drawn

    return on_root(comm, draw)


def draw_search(folder: Path, names: list[str] | None, formats: tuple[str, ...], comm: MPI.Comm) -> list[Path]:
    """Pictures of the (lambda, eta) search in ``folder``."""
    from vipetsc.figures import design_figures, draw_design

    def draw() -> list[Path]:
        _known(names, design_figures)
        try:
            return draw_design(folder, names, formats)
        except (OSError, KeyError) as error:
            raise FolderError(f"{folder / 'design.h5'}: is not a search of vipetsc ({error})") from None

    return on_root(comm, draw)


def _known(names: list[str] | None, figures: Collection[str]) -> None:
    unknown = set(names or []) - set(figures)
    if unknown:
        raise FolderError(f"--fig {' '.join(sorted(unknown))}: figures are {', '.join(figures)}")


def _together(own: list[Path], comm: MPI.Comm) -> list[Path]:
    return sorted(path for paths in comm.gather(own) or [] for path in paths)
