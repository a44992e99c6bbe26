"""The drawing loop: which rank draws which picture, and how a picture becomes a file."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from vipetsc.figures import style
from vipetsc.io.atomic import atomic_write

NOTE = 0.16  # height in inches of the strip that a note takes below a picture

Drawing = tuple[str, Callable[[], Figure]]
"""A picture to come: the stem of its file's name, and what draws it, to be called before the next is asked for."""


def draw_each(
    drawings: Iterable[Drawing],
    target: Path,
    formats: Sequence[str],
    turns: Iterator[int],
    note: str = "",
    keep: Callable[[Path], bool] = lambda path: False,
) -> list[Path]:
    """Draw those of ``drawings`` whose number is among ``turns``, into ``target/<stem>.<format>``.

    Parameters
    ----------
    turns
        Rising numbers, the next one asked for when a picture is done: every ``size``-th from a rank on shares
        the work evenly, a counter that all ranks draw from shares it by what it costs.
    note
        A line of text below every picture.
    keep
        Whether the file at a path is to stay as it is.

    Returns
    -------
    list of Path
        The files written, each complete.
    """
    written: list[Path] = []
    turn = next(turns, None)
    for number, (stem, make) in enumerate(drawings):
        if number != turn:
            continue
        paths = [target / f"{stem}.{suffix}" for suffix in formats]
        if not all(map(keep, paths)):
            figure = make()
            written += [save(figure, path, note) for path in paths]
        turn = next(turns, None)
    return written


def save(figure: Figure, path: Path, note: str = "") -> Path:
    """Write ``figure`` to ``path`` in the format of its suffix, atomically, with a ``note`` in a strip below it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    width, height = figure.get_size_inches()
    strip = Bbox([[0, -NOTE if note else 0], [width, height]])
    text = figure.text(1 - 0.05 / width, -0.3 * NOTE / height, note, ha="right", va="top", fontsize=7, color=style.GREY)
    with atomic_write(path) as partial_path:
        figure.savefig(partial_path, format=path.suffix[1:], dpi=style.DPI, bbox_inches=strip if note else None)
    text.remove()
    return path
