"""Figures that users have registered in modules of their own, which the case of a result names."""

import tomllib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from vipetsc import plugins
from vipetsc.case.parts import module_names
from vipetsc.figures.style import SCREEN, Drawing
from vipetsc.io.kinds import KINDS, PAPER, SWEEP
from vipetsc.io.netcdf import root_attributes
from vipetsc.register import FigurePart, PartError

MOST_PIXELS = 20_000  # 1.6 GB for a square picture
RESULTS = tuple(kind.file for kind in KINDS if kind != PAPER)


def registered_figures(source: str, folders: Sequence[Path]) -> tuple[dict[str, Callable[..., Any]], str]:
    """Return functions of registered figures of a ``source`` by name, and why modules cannot be imported, or "".

    The modules are those that the case of the results in the first of ``folders`` names. Sources are those of
    ``vipetsc.io.kinds``, functions those of ``vipetsc.figures.registry.FigureSpec``.
    """
    figures: dict[str, Callable[..., Any]] = {}
    if not folders:
        return figures, ""

    reasons = []
    for name in _modules(folders[0]):
        try:
            parts = plugins.load(name).parts
        except plugins.PluginError as error:
            reasons.append(f"{name}: {error}")
            continue
        for part in parts:
            if isinstance(part, FigurePart) and part.source == source:
                draw = partial(drawn, part)
                if source == SWEEP.source:
                    draw = partial(_each_sweep, draw)
                figures[part.name] = draw
    return figures, "; ".join(reasons)


def _modules(folder: Path) -> list[str]:
    """Return the modules that the case of the results in ``folder`` names; none if they cannot be read."""
    for pattern in RESULTS:
        # All branches of a folder have one case: the first one stands for them.
        for path in sorted(folder.glob(pattern))[:1]:
            try:
                case = tomllib.loads(root_attributes(path, "result").get("case", ""))
            # A file that cannot be read is reported when it is drawn.
            except (OSError, ValueError):
                return []
            return [plugins.located(name, folder) for name in module_names(case)]
    return []


def drawn(part: FigurePart, *results: Any) -> Figure:
    """Return the figure of a ``part``; raises PartError for one that fails, or returns something else."""
    figure = plugins.call(part, part.function, *results)
    if not isinstance(figure, Figure):
        raise PartError(f"the figure {part.name!r} of {part.file} returns {figure!r}; a Figure is needed")
    width, height = figure.get_size_inches() * SCREEN
    # Written so that NaN is refused, too.
    if not 1 <= width <= MOST_PIXELS or not 1 <= height <= MOST_PIXELS:
        size = f"{width:g} x {height:g} pixels at {SCREEN} dpi; at most {MOST_PIXELS} on either side are drawn"
        raise PartError(f"the figure {part.name!r} of {part.file} has {size}")
    return figure


def _each_sweep(draw: Callable[[xr.Dataset], Figure], sweeps: Sequence[xr.Dataset]) -> Iterator[Drawing]:
    """Yield a drawing of each of ``sweeps``: a registered figure shows one sweep, those of the registry all of them."""
    for ensemble in sweeps:
        yield Drawing("", partial(draw, ensemble))
