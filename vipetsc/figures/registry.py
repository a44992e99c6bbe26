"""The pictures of a run by name, and the drawing of them."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import h5py
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.bands import bands
from vipetsc.figures.dispersion import dispersion
from vipetsc.figures.impacts import impacts
from vipetsc.figures.lattice import unit_cell
from vipetsc.figures.ledger import ledger
from vipetsc.figures.phase import phase
from vipetsc.figures.spacetime import spacetime
from vipetsc.files import written_aside
from vipetsc.lattice import UnitCell
from vipetsc.records import RunFile

# The dearest first, so that ranks which share the work finish together.
run_figures: dict[str, Callable[[RunFile, h5py.File | None], Figure]] = {
    f.__name__: f for f in (spacetime, dispersion, phase, unit_cell, impacts, ledger)
}


def draw(
    folder: str | Path,
    names: Sequence[str] | None = None,
    formats: Sequence[str] = ("png",),
    share: tuple[int, int] = (0, 1),
) -> list[Path]:
    """Draw the run in ``folder`` (``run.h5``, ``analysis.h5``) into ``folder/figures/<name>.<format>``.

    Parameters
    ----------
    names
        Which of ``run_figures``; all by default.
    share
        (rank, size): draw every ``size``-th of them from ``rank`` on, so that ranks can share the work.

    Returns
    -------
    list of Path
        The files written, each complete or not there at all.

    Raises
    ------
    KeyError
        For a name that is not in ``run_figures``; says the nearest one.
    OSError, ValueError
        If the run cannot be read, or the picture not written.
    """
    names = list(run_figures if names is None else names)
    for name in names:
        if name not in run_figures:
            near = difflib.get_close_matches(name, run_figures, 1, 0) or list(run_figures)
            raise KeyError(f"no figure {name!r}; did you mean {near[0]!r}? There are {', '.join(run_figures)}")
    folder, written = Path(folder), []
    (folder / "figures").mkdir(exist_ok=True)
    rank, size = share
    with ExitStack() as stack:
        stack.enter_context(style.look())
        run = stack.enter_context(RunFile(folder / "run.h5"))
        measured = folder / "analysis.h5"
        analysis = stack.enter_context(h5py.File(measured, "r")) if measured.exists() else None
        for name in names[rank::size]:
            figure = run_figures[name](run, analysis)
            written += [save(figure, folder / "figures" / f"{name}.{kind}") for kind in formats]
    return written


def names() -> tuple[str, ...]:
    """The names of all pictures of a run."""
    return tuple(run_figures)


def draw_bands(cell: UnitCell, path: str | Path, frequency: float | None = None) -> Path:
    """Draw the dispersion diagram of ``cell`` into ``path``; ``frequency`` in rad/s marks a drive."""
    with style.look():
        return save(bands(cell, frequency), Path(path))


def save(figure: Figure, path: Path) -> Path:
    """Write ``figure`` to ``path`` in the format of its suffix, under another name first."""
    with written_aside(path) as aside:
        figure.savefig(aside, format=path.suffix[1:], dpi=style.DPI)
    return path
