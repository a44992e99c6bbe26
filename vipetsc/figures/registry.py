"""The pictures of a run by name, and the drawing of them."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import h5py
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from vipetsc.figures import style
from vipetsc.figures.bands import bands
from vipetsc.figures.dispersion import dispersion
from vipetsc.figures.impacts import impacts
from vipetsc.figures.lattice import unit_cell
from vipetsc.figures.ledger import ledger
from vipetsc.figures.phase import phase
from vipetsc.figures.spacetime import spacetime
from vipetsc.figures.style import Drawing
from vipetsc.io.atomic import atomic_write
from vipetsc.io.run_file import RunFile
from vipetsc.lattice import UnitCell

NOTE = 0.16  # height in inches of the strip that a note takes below a picture

# The dearest first, so that ranks which share the work finish together.
run_figures: dict[str, Callable[[RunFile, h5py.File | None], Figure]] = {
    f.__name__: f for f in (spacetime, dispersion, phase, unit_cell, impacts, ledger)
}


def chosen(names: Sequence[str] | None, figures: Mapping[str, object]) -> list[str]:
    """``names``, all of ``figures`` if None; raises KeyError for one that is not there, with the nearest that is."""
    for name in names or ():
        if name not in figures:
            near = difflib.get_close_matches(name, figures, 1, 0) or list(figures)
            raise KeyError(f"no figure {name!r}; did you mean {near[0]!r}? There are {', '.join(figures)}")
    return list(figures if names is None else names)


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
    names = chosen(names, run_figures)
    folder = Path(folder)
    (folder / "figures").mkdir(exist_ok=True)
    rank, size = share
    with ExitStack() as stack:
        stack.enter_context(style.rc_style())
        run = stack.enter_context(RunFile(folder / "run.h5"))
        measured = folder / "analysis.h5"
        analysis = stack.enter_context(h5py.File(measured, "r")) if measured.exists() else None
        drawings = ((name, partial(run_figures[name], run, analysis)) for name in names)
        return draw_each(drawings, folder / "figures", formats, itertools.count(rank, size))


def names() -> tuple[str, ...]:
    """The names of all pictures of a run."""
    return tuple(run_figures)


def draw_bands(cell: UnitCell, path: str | Path, frequency: float | None = None) -> Path:
    """Draw the dispersion diagram of ``cell`` into ``path``; ``frequency`` in rad/s marks a drive."""
    with style.rc_style():
        return save(bands(cell, frequency), Path(path))


def draw_each(
    drawings: Iterable[Drawing],
    target: Path,
    formats: Sequence[str],
    turns: Iterator[int],
    note: str = "",
    keep: Callable[[Path], bool] = lambda path: False,
) -> list[Path]:
    """Draw those of ``drawings`` (stem, figure) whose number is among ``turns``, into ``target/<stem>.<format>``.

    Parameters
    ----------
    turns
        Rising numbers, the next one asked for when a picture is done: every ``size``-th from a rank on shares
        the work evenly, a counter that all ranks draw from shares it by what it costs.
    note
        Words that stand below every picture.
    keep
        Whether the file at a path is to stay as it is.

    Returns
    -------
    list of Path
        The files written.
    """
    written: list[Path] = []
    mine = next(turns, None)
    for number, (stem, make) in enumerate(drawings):
        if number != mine:
            continue
        paths = [target / f"{stem}.{kind}" for kind in formats]
        if not all(map(keep, paths)):
            figure = make()
            written += [save(figure, path, note) for path in paths]
        mine = next(turns, None)
    return written


def save(figure: Figure, path: Path, note: str = "") -> Path:
    """Write ``figure`` to ``path`` in the format of its suffix, under another name first; a ``note`` goes below it."""
    width, height = figure.get_size_inches()
    strip = Bbox([[0, -NOTE if note else 0], [width, height]])
    text = figure.text(1 - 0.05 / width, -0.3 * NOTE / height, note, ha="right", va="top", fontsize=7, color=style.GREY)
    with atomic_write(path) as aside:
        figure.savefig(aside, format=path.suffix[1:], dpi=style.DPI, bbox_inches=strip if note else None)
    text.remove()
    return path
