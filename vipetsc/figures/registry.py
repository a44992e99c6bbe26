"""Every picture by name: what it is drawn from and by which function; the check of names; the drawing of folders."""

import difflib
import itertools
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr
from matplotlib.figure import Figure

from vipetsc.figures import (
    condensed_branches,
    cost_maps,
    entropy,
    law_panels,
    modal,
    nfrc,
    optimum,
    predicted_energies,
    runs,
    scattering,
    schematics,
    transfer,
    transfer_curves,
)
from vipetsc.figures.style import Drawing, draw_each, rc_style, save
from vipetsc.figures.sweep_members import Files, Sweeps, table
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_ensemble, open_run
from vipetsc.lattice import UnitCell

MOST_WARNINGS = 4  # below a picture
RUN, SWEEP, BRANCHES, DESIGN = "run", "sweep", "branches", "design"
OPTIMUM, LAW, PREDICTION = "optimum", "law", "prediction"
FILES = {DESIGN: ("design.h5", ("cost", "frequency")), OPTIMUM: ("optimum.h5", ("value", "comparison")),
         LAW: ("law.h5", ("share", "efficiency")),
         PREDICTION: ("prediction.h5", ("predicted", "onset_amplitude"))}  # fmt: skip


class FigureSpec(NamedTuple):
    """A figure of what folders of a ``source`` hold; one of sweeps is drawn from those that take the ``measure``.

    ``function`` is (run, analysis or None) -> Figure for a run, (search) -> Figure for a design or an optimum,
    (paths) -> Figure for branches; of sweeps it offers drawings: (ensembles) -> iterator of (suffix, () -> Figure).
    """

    function: Callable[..., Any]
    source: str
    measure: str = ""


def _specs(source: str, *functions: Callable[..., Any], measure: str = "") -> dict[str, FigureSpec]:
    return {f.__name__: FigureSpec(f, source, measure) for f in functions}


# The dearest of a run first, so that ranks which share the work finish together.
FIGURES = {
    **_specs(RUN, modal.modal_energies),
    **_specs(RUN, runs.spacetime, runs.dispersion, runs.phase, schematics.unit_cell, runs.impacts, runs.ledger),
    **_specs(SWEEP, scattering.amplitudes, scattering.wavelets, scattering.partition, measure="entropy"),
    **_specs(SWEEP, scattering.partition_explained, scattering.reconstruction, measure="entropy"),
    **_specs(SWEEP, entropy.entropy, entropy.entropy_all, measure="entropy"),
    **_specs(SWEEP, scattering.entropy_maps, entropy.entropy_history, measure="entropy"),
    **_specs(SWEEP, transfer.transfer, transfer.transfer_dispersions, transfer.band_energies, measure="transfer"),
    **_specs(SWEEP, transfer_curves.ibtet, transfer_curves.ibtet_backbone, measure="transfer"),
    **_specs(SWEEP, transfer_curves.phase_regimes, measure="transfer"),
    "branch": FigureSpec(condensed_branches.branches, BRANCHES),
    **_specs(DESIGN, cost_maps.deflections, cost_maps.cost_maps),
    **_specs(LAW, law_panels.law),
    **_specs(PREDICTION, predicted_energies.prediction),
    **_specs(OPTIMUM, optimum.convergence, optimum.compared_designs, optimum.compared_curves),
    "dispersion_against_lambda": FigureSpec(partial(cost_maps.dispersions, along="lambda", other="eta"), DESIGN),
    "dispersion_against_eta": FigureSpec(partial(cost_maps.dispersions, along="eta", other="lambda"), DESIGN),
}


def figure_names(source: str, names: Sequence[str] | None = None) -> list[str]:
    """The ``names``, by default those of all figures of ``source``; raises KeyError for one that is not among them."""
    valid = [name for name, spec in FIGURES.items() if spec.source == source]
    for name in names or ():
        if name not in valid:
            (nearest,) = difflib.get_close_matches(name, valid, 1, 0) or valid[:1]
            of = source if source == BRANCHES else f"a {source}"
            raise KeyError(f"no figure {name!r} of {of}; did you mean {nearest!r}? There are {', '.join(valid)}")
    return valid if names is None else list(names)


def draw(
    source: str,
    folders: Sequence[Path],
    names: Sequence[str] | None = None,
    formats: Sequence[str] = ("png",),
    share: tuple[int, int] = (0, 1),
    newest: float | None = None,
) -> list[Path]:
    """Draw what the ``folders`` hold into ``figures/`` of the first of them; returns the files, each complete.

    The ``source``, what is in the folders, is "run" (one folder), "sweep" (with branches beside them), "branches" (of
    the same names, side by side), "design", "optimum" or "law" (one folder); ``names`` are figures, all by default.
    With a ``share`` (rank, size) every ``size``-th picture from ``rank`` on is drawn; pictures that are not older than
    the time ``newest`` stay. Raises KeyError for a name that is no figure of ``source`` and for a file that lacks
    something, OSError or ValueError if a file cannot be read, or a picture not written.
    """

    def keep(path: Path) -> bool:
        return newest is not None and path.exists() and path.stat().st_mtime >= newest

    turns = itertools.count(*share)
    with rc_style(), Files() as files:
        return draw_each(drawings(source, folders, files, names), folders[0] / "figures", formats, turns, keep=keep)


def warned(make: Callable[[], Figure], *results: xr.Dataset) -> Callable[[], Figure]:
    """``make``, whose figure is labelled with the warnings in the ``results``: their attribute ``warnings`` (JSON)."""
    warnings = (line for data in results for line in json.loads(data.attrs.get("warnings", "[]")))
    sentences = [*dict.fromkeys(warnings)]
    if len(sentences) > MOST_WARNINGS:
        sentences[MOST_WARNINGS - 1 :] = [f"{len(sentences) - MOST_WARNINGS + 1} more warnings are in the file"]

    def labelled() -> Figure:
        figure = make()
        figure.set_label("\n".join(sentences))
        return figure

    return labelled


def draw_bands(cell: UnitCell, path: str | Path, frequency: float | None = None) -> Path:
    """Draw the dispersion diagram of ``cell`` into ``path``; ``frequency`` in rad/s marks a drive."""
    sys.audit("vipetsc.draw", "bands")
    with rc_style():
        return save(runs.bands(cell, frequency), Path(path))


def drawings(
    source: str, folders: Sequence[Path], files: Files, names: Sequence[str] | None = None
) -> Iterator[Drawing]:
    """Stems and drawings of what the ``folders`` hold, as ``draw`` draws them; the first of them checks the names.

    Warnings in the files are the figures' labels. A drawing can be called as long as its ``files`` are open.
    """
    specs = {name: FIGURES[name] for name in figure_names(source, names)}
    folder = folders[0]
    if source == SWEEP:
        ensembles = [files.get(path, open_ensemble) for path in folders if (path / "ensemble.h5").exists()]
        for name, spec in specs.items():
            measured = Sweeps((e for e in ensembles if spec.measure in table(e)["sweep"]["measures"]), files)
            for suffix, make in spec.function(measured):
                yield f"{name}-{suffix}" if suffix else name, warned(make, *measured)
    elif source == BRANCHES:
        for spec, path in itertools.product(specs.values(), sorted(folder.glob("branch-*.h5"))):
            paths = [other / path.name for other in folders if (other / path.name).exists()]
            stem = path.stem.replace("branch", "branches" if len(folders) > 1 else "branch", 1)
            branches = [files.get(path, partial(open_netcdf, kind="branch")) for path in paths]
            function = nfrc.answers if "share" in branches[0] else spec.function  # of the verb nfrc, or nnm
            yield stem, warned(partial(function, paths), *branches)
    elif source == RUN:
        run, analysis = files.get(folder / "run.h5", open_run), None
        if (folder / "analysis.h5").exists():
            analysis = files.get(folder / "analysis.h5", partial(open_netcdf, kind="analysis"))
        of_run = [data for data in (run, analysis) if data is not None]
        yield from ((name, warned(partial(spec.function, run, analysis), *of_run)) for name, spec in specs.items())
    else:
        file, needs = FILES[source]
        search = files.get(folder / file, partial(open_netcdf, kind="search", needs=needs))
        yield from ((name, partial(spec.function, search)) for name, spec in specs.items())
