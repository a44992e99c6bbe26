"""Pictures of results as figures of matplotlib, for scripts and notebooks."""

from functools import partial
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from vipetsc.dynamics.result import Result
from vipetsc.figures.registry import drawings, figure_names, figures_of
from vipetsc.figures.style import NoPicture, Shown, rc_style
from vipetsc.figures.sweep_members import Files
from vipetsc.io.kinds import KINDS, RUN
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_run
from vipetsc.studies.analysis import analyse


def plot(results: Result | xr.Dataset | str | Path, name: str) -> Figure:
    """Return the picture ``name`` of ``results`` as a figure of matplotlib.

    ``results`` are what ``simulate`` returns, a run in memory, or the folder of a run or of a study. The names are
    those of the command ``plot``: of a run "spacetime", "dispersion" or "poincare", of a sweep those of its measures,
    "ibtet", and "bifurcation". Of several pages the first is returned. A run without an analysis is analysed.

    Raises ValueError for a name that the results do not have, with a list of those that they have, and for a picture
    that they do not allow, with the reason.
    """
    if isinstance(results, Result):
        if results.folder is not None:
            results = results.folder
        elif results.dataset is not None:
            results = results.dataset
        else:
            raise ValueError(f"{name}: the run was stopped, or is that of another rank")

    with rc_style(), Files() as files:
        try:
            if isinstance(results, xr.Dataset):
                figure_names(RUN.source, [name])
                return _of_run(results, analyse(results), name, Path())
            return _of_folder(Path(results), name, files)
        except KeyError as error:
            raise ValueError(str(error.args[0])) from None
        except NoPicture as none:
            raise ValueError(f"{name}: {none}") from None


def _of_folder(folder: Path, name: str, files: Files) -> Figure:
    """Return the picture ``name`` of the results in a ``folder``, opened as ``files``; raise as `plot`."""
    kind = next((kind for kind in KINDS if any(folder.glob(kind.file))), None)
    if kind is None:
        raise ValueError(f"{folder} contains no results")
    figure_names(kind.source, [name], [folder], files)
    if kind != RUN:
        return next(drawings(kind.source, [folder], files, [name])).draw()

    run = files.get(folder / "run.h5", open_run)
    # ``simulate`` leaves the run alone, the command ``run`` its analysis, too.
    if (folder / "analysis.h5").exists():
        analysis = files.get(folder / "analysis.h5", partial(open_netcdf, kind="analysis"))
    else:
        analysis = analyse(run)
    return _of_run(run, analysis, name, folder)


def _of_run(run: xr.Dataset, analysis: xr.Dataset, name: str, folder: Path) -> Figure:
    """Return the picture ``name`` of a ``run``, in memory or in a ``folder``, with its ``analysis``."""
    spec = figures_of(RUN.source, [folder])[name]
    if spec.together:
        return spec.function([Shown("", [run, analysis])], ())
    return spec.function(run, analysis)
