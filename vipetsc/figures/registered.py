"""Figures of users' modules: those of the modules that a result's case names."""

import tomllib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from vipetsc import plugins
from vipetsc.case.parts import module_names
from vipetsc.figures.style import Drawing
from vipetsc.io.netcdf import root_attributes
from vipetsc.register import FigurePart, PartError

RESULTS = ("run.h5", "ensemble.h5", "branch-*.h5", "design.h5", "optimum.h5", "law.h5", "prediction.h5")


def registered_figures(source: str, folders: Sequence[Path]) -> tuple[dict[str, Callable[..., Any]], str]:
    """Functions of the figures of a ``source`` by name, and why modules cannot be imported, if one cannot.

    The modules are those of the case of the results in the first of ``folders``. A ``source`` is as in
    ``vipetsc.figures.registry``.
    """
    figures: dict[str, Callable[..., Any]] = {}
    reasons = []
    for name in _modules(folders[0]) if folders else []:
        try:
            parts = plugins.load(name).parts
        except plugins.PluginError as error:
            reasons.append(f"{name}: {error}")
            continue
        for part in parts:
            if isinstance(part, FigurePart) and part.source == source:
                draw = partial(_drawn, part)
                figures[part.name] = partial(_of_sweeps, draw) if source == "sweep" else draw
    return figures, "; ".join(reasons)


def _modules(folder: Path) -> list[str]:
    """The modules that the case of the results in ``folder`` names."""
    for pattern in RESULTS:
        # All branches of a folder have one case: the first one stands for them.
        for path in sorted(folder.glob(pattern))[:1]:
            try:
                case = tomllib.loads(root_attributes(path, "result").get("case", ""))
            # What cannot be read is reported where it is drawn.
            except (OSError, ValueError):
                return []
            return [plugins.located(name, folder) for name in module_names(case)]
    return []


def _drawn(part: FigurePart, *results: Any) -> Figure:
    """The figure of a ``part``; raises PartError for one that fails, or returns something else."""
    figure = plugins.call(part, part.function, *results)
    if not isinstance(figure, Figure):
        raise PartError(f"the figure {part.name!r} of {part.file} returns {figure!r}; a Figure is needed")
    return figure


def _of_sweeps(draw: Callable[[xr.Dataset], Figure], sweeps: Sequence[xr.Dataset]) -> Iterator[Drawing]:
    """A drawing of each ensemble."""
    for ensemble in sweeps:
        yield Drawing("", partial(draw, ensemble))
