"""Every picture by name: what it is drawn from and by which function; the check of names; the drawing of folders."""

import itertools
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import xarray as xr
from matplotlib.figure import Figure

from vipetsc.case.strip import StripTable
from vipetsc.figures import (
    condensed_branches,
    cost_maps,
    damped_modes,
    frequency_energy,
    identified,
    impact_panels,
    law_panels,
    measure_pages,
    modal,
    nfrc,
    optimum,
    points,
    predicted_energies,
    response_family,
    response_outputs,
    runs,
    scattering,
    schematics,
    sections,
    strips,
    transfer,
    transfer_curves,
    wavenumber_bins,
)
from vipetsc.figures.look import Look
from vipetsc.figures.registered import registered_figures
from vipetsc.figures.style import Drawing, LeftOut, Shown, draw_each, rc_style, save
from vipetsc.figures.sweep_members import Files, Sweeps, in_file_name, table
from vipetsc.figures.warning_lines import warned
from vipetsc.io import branch_kinds
from vipetsc.io.kinds import BRANCHES, IDENTIFIED, KIND_OF, LAW, OPTIMUM, PREDICTION, RUN, SEARCH, SWEEP, ResultKind
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_ensemble, open_run
from vipetsc.lattice import UnitCell
from vipetsc.register import FIGURE, reserve
from vipetsc.wording import nearest


class FigureSpec(NamedTuple):
    """A figure: its ``name``, the ``kind`` of results that it is drawn from, and the ``function`` that draws it.

    Attributes
    ----------
    function
        Of a run, (run, analysis or None) -> Figure. Of one of ``STUDIES``, (data) -> Figure. Of branches, (paths) ->
        Figure. Of sweeps, (sweeps) -> iterator of Drawing; the name of such a drawing's file is that of the figure,
        followed by the drawing's stem.
    measure
        Of sweeps, a word that ``sweep.measures`` of the case must have; the function gets no other sweeps.
    needs
        What results must hold, for a figure that few results have: nothing is said where they do not hold it, unless
        the figure is asked for.
    together
        Whether one picture shows all branches, or runs, of all folders. The function of such a figure of runs is
        (runs, records) -> Figure.
    on_request
        Whether it is drawn only if it is asked for.
    without
        Words of warnings that do not concern the figure: those with one of them are not printed below it.
    """

    name: str
    kind: ResultKind
    function: Callable[..., Any]
    measure: str = ""
    needs: str = ""
    together: bool = False
    on_request: bool = False
    without: tuple[str, ...] = ()


def branch(paths: Sequence[Path]) -> Figure:
    """Draw the branches in ``paths``, which are of one kind, side by side."""
    kinds = [branch_kinds.kind_of_file(path) for path in paths]
    # Folders on one page may hold branches of one name and different kinds: those of the first one's kind are shown.
    same = [path for path, kind in zip(paths, kinds, strict=True) if kind == kinds[0]]
    return BRANCH_FIGURES[kinds[0]](same)


BRANCH_FIGURES: Mapping[str, Callable[[Sequence[Path]], Figure]] = {
    branch_kinds.ORBITS: frequency_energy.backbone,
    branch_kinds.BALANCE: condensed_branches.condensed_branches,
    branch_kinds.RESPONSES: nfrc.frequency_response,
    branch_kinds.DAMPED: damped_modes.damped_modes,
}

BRANCH = "branch"  # the figure of branches
OVER_BRANCHES = "ibtet_backbone"  # the figure of sweeps that shows branches too

# What sweeps must hold for a figure.
WHOLE_MEMBERS = "members with their fields ([sweep] fields = true), contact sites and a band above the driven one"
THREE_AMPLITUDES = "members with their fields ([sweep] fields = true) at three values of drive.amplitude"
POINTS_KEPT = "one swept number, members with their fields ([sweep] fields = true), points and time.samples_per_period"
BRANCHES_TOO = "branches of the same law, in a further folder, and a sweep over drive.amplitude"

# Words of warnings about histories and their amplitudes, which a picture of states once a period does not show.
HISTORIES = "sample_interval", "steady amplitude", "of steady_"

_SPECS = (
    # The figures of a run are listed by falling duration, so that ranks which share them end at about the same time.
    FigureSpec("modal_energies", RUN, modal.modal_energies),
    FigureSpec("spacetime", RUN, runs.spacetime),
    FigureSpec("dispersion", RUN, runs.dispersion),
    FigureSpec("phase", RUN, runs.phase),
    FigureSpec("envelope", RUN, strips.envelope, needs="[lattice.strip]"),
    FigureSpec("snapshots", RUN, strips.snapshots, needs="[lattice.strip]"),
    FigureSpec("wave_vectors", RUN, strips.wave_vectors, needs="[lattice.strip]"),
    FigureSpec("unit_cell", RUN, schematics.unit_cell),
    FigureSpec("impacts", RUN, impact_panels.impacts),
    FigureSpec("ledger", RUN, runs.ledger),
    *(
        FigureSpec(name, RUN, draw, needs="[output] points", together=True, on_request=name != "points")
        for name, draw in points.FIGURES.items()
    ),
    FigureSpec(
        "poincare", RUN, sections.poincare, needs="[output] points and time.samples_per_period", without=HISTORIES
    ),
    FigureSpec("bifurcation", SWEEP, sections.bifurcation, needs=POINTS_KEPT, without=HISTORIES),
    FigureSpec("amplitudes", SWEEP, scattering.amplitudes, measure="entropy", needs=THREE_AMPLITUDES),
    FigureSpec("wavelets", SWEEP, scattering.wavelets, measure="entropy", needs=THREE_AMPLITUDES),
    FigureSpec("partition", SWEEP, wavenumber_bins.partition, measure="entropy", needs=THREE_AMPLITUDES),
    FigureSpec("partition_explained", SWEEP, wavenumber_bins.partition_explained, "entropy", needs=THREE_AMPLITUDES),
    FigureSpec("reconstruction", SWEEP, wavenumber_bins.reconstruction, measure="entropy", needs=THREE_AMPLITUDES),
    FigureSpec("entropy_maps", SWEEP, scattering.entropy_maps, measure="entropy", needs=THREE_AMPLITUDES),
    FigureSpec("transfer", SWEEP, transfer.transfer, measure="transfer", needs=WHOLE_MEMBERS),
    FigureSpec("transfer_dispersions", SWEEP, transfer.transfer_dispersions, measure="transfer", needs=WHOLE_MEMBERS),
    FigureSpec("band_energies", SWEEP, transfer.band_energies, measure="transfer", needs=WHOLE_MEMBERS),
    FigureSpec(OVER_BRANCHES, SWEEP, transfer_curves.ibtet_backbone, measure="transfer", needs=BRANCHES_TOO),
    FigureSpec("phase_regimes", SWEEP, transfer_curves.phase_regimes, measure="transfer", needs=WHOLE_MEMBERS),
    FigureSpec(BRANCH, BRANCHES, branch),
    FigureSpec("outputs", BRANCHES, response_outputs.response_outputs, needs="[output] points or forces"),
    FigureSpec("responses", BRANCHES, response_family.response_family, needs="several curves", together=True),
    FigureSpec("deflections", SEARCH, cost_maps.deflections),
    FigureSpec("cost_maps", SEARCH, cost_maps.cost_maps),
    FigureSpec("dispersion_against_lambda", SEARCH, partial(cost_maps.dispersions, along="lambda", other="eta")),
    FigureSpec("dispersion_against_eta", SEARCH, partial(cost_maps.dispersions, along="eta", other="lambda")),
    FigureSpec("law", LAW, law_panels.law),
    FigureSpec("prediction", PREDICTION, predicted_energies.prediction),
    FigureSpec("convergence", OPTIMUM, optimum.convergence),
    FigureSpec("compared_designs", OPTIMUM, optimum.compared_designs),
    FigureSpec("compared_curves", OPTIMUM, optimum.compared_curves),
    *(FigureSpec(draw.__name__, IDENTIFIED, draw) for draw in identified.FIGURES),
)
# Nothing may take a figure out and put it back: pictures, and messages about them, come in the order of this table.
FIGURES: Mapping[str, FigureSpec] = MappingProxyType({spec.name: spec for spec in _SPECS})
reserve(FIGURE, FIGURES)


def figures_of(source: str, folders: Sequence[Path]) -> dict[str, FigureSpec]:
    """Return the figures of ``source`` by name, with those of the modules that the results in ``folders`` name."""
    registered, _ = registered_figures(source, folders)
    specs = {name: spec for name, spec in FIGURES.items() if spec.kind.source == source}
    return specs | {name: FigureSpec(name, KIND_OF[source], function) for name, function in registered.items()}


def figure_names(
    source: str, names: Sequence[str] | None = None, folders: Sequence[Path] = (), files: Files | None = None
) -> list[str]:
    """Return ``names``, or by default those of all figures of ``source``; raise KeyError for an unknown one.

    Each measure in the ``folders`` of sweeps is a figure too; by default those are returned that most readers look at.
    ``files`` are results that the caller has opened and will close.
    """
    specified = [*figures_of(source, folders)]
    measures: dict[str, str] = {}
    if source == SWEEP.source:
        with Files() as opened_here:
            opened = opened_here if files is None else files
            for folder in with_ensemble(folders):
                ensemble = opened.get(folder, open_ensemble)
                measures |= {measure_pages.figure_name(name): name for name in measure_pages.measures_of(ensemble)}
    if names is None:
        shown = [name for name in measures if not measure_pages.is_on_request(measures[name])]
        return [*shown, *(name for name in specified if name not in FIGURES or not FIGURES[name].on_request)]

    valid = [*measures, *specified]
    for name in names:
        if name not in valid:
            near = nearest(name, valid)
            question = f"; did you mean {near!r}?" if near else "."
            holder = source
            if source != BRANCHES.source:
                article = "an" if source[0] in "aeiou" else "a"
                holder = f"{article} {source}"
            listed = ", ".join(valid)
            _, missing = registered_figures(source, folders)
            reason = ""
            if missing:
                reason = f"; a module of the case cannot be used: {missing}"
            raise KeyError(f"no figure {name!r} of {holder}{question} There are {listed}{reason}")
    return list(names)


def with_ensemble(folders: Iterable[Path]) -> list[Path]:
    """Return the folders of sweeps; others on one page with them hold branches."""
    return [folder for folder in folders if (folder / "ensemble.h5").exists()]


def draw(
    source: str,
    folders: Sequence[Path],
    names: Sequence[str] | None = None,
    formats: Sequence[str] = ("png",),
    *,
    turns: Iterator[int] | None = None,
    newest: float | None = None,
    omit: Collection[str] = (),
    files: Files | None = None,
    left_out: LeftOut | None = None,
    look: Look | None = None,
    records: Sequence[str] = (),
) -> list[Path]:
    """Draw what the ``folders`` hold into ``figures/`` of the first of them; return the files, each complete.

    Parameters
    ----------
    source
        Contents of the folders, a name in ``vipetsc.io.kinds``: "sweep" (perhaps with folders of branches), "branches"
        (those of one name side by side), "run" (of several those figures that show them together); of one folder
        "design", "optimum", "identification", "law" or "prediction".
    names
        Figures, and of sweeps measures; by default all figures, and the measures that most readers look at.
    turns
        Rising numbers of the pictures to draw, from 0, as of ``draw_each``; by default all.
    newest
        A time in s since the epoch: pictures that are not older stay.
    omit
        Figures that are left out.
    files
        Results that the caller has opened and will close.
    left_out
        Gets the reasons of pictures that have nothing to show.
    look
        What a user asks of all pictures.
    records
        Records of named points to draw over runs, FILE or FILE:COLUMN=POINT.

    Raises
    ------
    ResultFileError
        For results with numbers that are not finite, or none, of which a figure cannot be drawn.
    KeyError
        For a name that is no figure of ``source``, and for a file that lacks something.
    OSError, ValueError
        If a file cannot be read, or a picture not written.
    """

    def keep(path: Path) -> bool:
        return newest is not None and path.exists() and path.stat().st_mtime >= newest

    with rc_style(look.style if look else None), Files() as opened_here:
        opened = opened_here if files is None else files
        with opened.naming_spoilt():
            return draw_each(
                drawings(source, folders, opened, names, omit, records),
                target=folders[0] / "figures",
                formats=formats,
                turns=itertools.count() if turns is None else turns,
                keep=keep,
                left_out=left_out,
                look=look,
            )


def draw_bands(
    cell: UnitCell, path: str | Path, frequency: float | None = None, strip: StripTable | None = None
) -> Path:
    """Draw the dispersion diagram of ``cell``, perhaps that of a ``strip``, into ``path``.

    ``frequency`` in rad/s marks a drive.
    """
    sys.audit("vipetsc.draw", "bands")
    with rc_style():
        if strip is not None and strip.rows > 1:
            return save(strips.bands(strip, cell, frequency), Path(path))
        return save(runs.bands(cell, frequency), Path(path))


def drawings(
    source: str,
    folders: Sequence[Path],
    files: Files,
    names: Sequence[str] | None = None,
    omit: Collection[str] = (),
    records: Sequence[str] = (),
) -> Iterator[Drawing]:
    """Return the drawings that ``draw`` draws with these arguments, in its order.

    A figure has the warnings in its files as its label. A drawing can be called as long as its ``files`` are open.
    Raises KeyError as ``figure_names``.
    """
    chosen = [name for name in figure_names(source, names, folders, files) if name not in omit]
    if source == SWEEP.source:
        return _sweep_drawings(chosen, folders, files, by_name=names is not None)
    named = figures_of(source, folders)
    specs = [named[name] for name in chosen]
    if source == BRANCHES.source:
        return _branch_drawings(specs, folders, files)
    if source == RUN.source:
        return _run_drawings(specs, folders, files, records)
    return _file_drawings(specs, folders[0], files)


def _sweep_drawings(names: Sequence[str], folders: Sequence[Path], files: Files, by_name: bool) -> Iterator[Drawing]:
    """Yield the pages of measures and what the other figures offer, each with a stem of its own."""
    ensembles = [files.get(folder, open_ensemble) for folder in with_ensemble(folders)]
    used: dict[str, int] = {}
    specs = figures_of(SWEEP.source, folders)
    for name in names:
        if name in specs:
            offered = _needed_drawings(specs[name], ensembles, folders, files)
        else:
            offered = _measure_drawings(name, ensembles, by_name)
        for drawing in offered:
            # Two sweeps in one folder of pictures may offer one stem, and the second would replace the first.
            used[drawing.stem] = used.get(drawing.stem, 0) + 1
            count = used[drawing.stem]
            stem = drawing.stem
            if count > 1:
                stem += f"-no-{count}"
            yield drawing._replace(stem=stem, figure=name)


def _needed_drawings(
    spec: FigureSpec, ensembles: Sequence[xr.Dataset], folders: Sequence[Path], files: Files
) -> Iterator[Drawing]:
    """Yield what ``spec`` offers of the sweeps; of sweeps that lack what it needs a drawing without a picture."""
    is_empty = True
    for drawing in specified_drawings(spec, ensembles, files):
        yield drawing
        is_empty = False
    if is_empty:
        unrelated = ""
        if spec.name == OVER_BRANCHES:
            unrelated = transfer_curves.curves_left_out(folders)
        yield Drawing.without_picture(spec.name, unrelated or f"needs {spec.needs}")


def _measure_drawings(name: str, ensembles: Sequence[xr.Dataset], by_name: bool) -> Iterator[Drawing]:
    """Yield the pages of the measure of that ``name``, sweep after sweep."""
    for ensemble in ensembles:
        sweep = table(ensemble)["name"] if len(ensembles) > 1 else ""
        stem = "-".join(filter(None, [name, sweep]))
        measures = [m for m in measure_pages.measures_of(ensemble) if measure_pages.figure_name(m) == name]
        if not measures:
            yield Drawing.without_picture(stem, "the sweep does not measure it")
        for measure in measures:
            if reason := measure_pages.reason_without_page(ensemble, measure, by_name):
                yield Drawing.without_picture(stem, reason)
                continue
            others = [other for other in ensembles if other is not ensemble and measure in other]
            for drawing in measure_pages.measure_pages(ensemble, measure, sweep, others):
                yield drawing._replace(draw=warned(drawing.draw, [Shown(sweep, [ensemble])]))


def specified_drawings(spec: FigureSpec, ensembles: Sequence[xr.Dataset], files: Files) -> Iterator[Drawing]:
    """Yield what the function of ``spec`` offers of the sweeps that take its measure."""
    measured = [
        ensemble for ensemble in ensembles if not spec.measure or spec.measure in table(ensemble)["sweep"]["measures"]
    ]
    sweeps = Sweeps(measured, files)
    whole_sweeps = [Shown(str(table(sweep).get("name", "")), [sweep]) for sweep in sweeps]
    for offered in spec.function(sweeps):
        stem = f"{spec.name}-{offered.stem}" if offered.stem else spec.name
        yield Drawing(stem, warned(offered.draw, offered.shown or whole_sweeps, spec.without))


def _branch_drawings(specs: Sequence[FigureSpec], folders: Sequence[Path], files: Files) -> Iterator[Drawing]:
    """Yield drawings of the branches of each name that the first folder has, from all folders; then of all together."""
    for paths in branches_by_name(folders):
        for spec in specs:
            if not spec.together:
                yield from _branch_drawing(spec, paths, len(folders), files)

    for spec in specs:
        if spec.together:
            for drawing in _branch_drawing(spec, every_branch(folders, files), len(folders), files):
                yield drawing._replace(stem=spec.name)


def _branch_drawing(spec: FigureSpec, paths: Sequence[Path], folders: int, files: Files) -> Iterator[Drawing]:
    """Yield the drawing of the branches in ``paths``, from so many ``folders``; none if there is nothing to show."""
    branches = [open_branch(path, files) for path in paths]
    stem = paths[0].stem if paths else spec.name
    if not all(map(has_points, branches)):
        yield Drawing.without_picture(stem, "no point of the branch was computed")._replace(figure=spec.name)
        return

    if spec.name != BRANCH:
        stem = stem.replace(BRANCH, spec.name, 1)
    elif folders > 1:
        stem = stem.replace(BRANCH, "branches", 1)
    draw_branches = warned(partial(spec.function, paths), _shown_branches(paths, branches, files))
    yield Drawing(stem, draw_branches, figure=spec.name)


def _shown_branches(paths: Sequence[Path], branches: Sequence[xr.Dataset], files: Files) -> list[Shown]:
    """Return the ``branches`` by their names, those of one name by their folders' names too.

    A branch towards larger energies is shown with the one towards smaller energies, if the mode has both.
    """
    names = [str(branch.attrs["name"]) for branch in branches]
    if len(set(names)) < len(names):
        names = [f"{path.parent.name}, {name}" for path, name in zip(paths, names, strict=True)]
    shown = []
    for name, path, branch in zip(names, paths, branches, strict=True):
        below = path.with_name(f"{path.stem}{branch_kinds.DOWN}.h5")
        shown.append(Shown(name, [branch, open_branch(below, files)] if below.exists() else [branch]))
    return shown


def open_branch(path: Path, files: Files) -> xr.Dataset:
    """Return the branch in ``path``, opened as one of the ``files``."""
    return files.get(path, partial(open_netcdf, kind="branch"))


def has_points(branch: xr.Dataset) -> bool:
    """Return whether a point of a branch was computed."""
    return branch.sizes["point"] > 0


def branches_by_name(folders: Sequence[Path]) -> list[list[Path]]:
    """Return for each branch of the first of ``folders`` the files of its name in all that have one."""
    groups = []
    for first in sorted(folders[0].glob("branch-*.h5")):
        groups.append([folder / first.name for folder in folders if (folder / first.name).exists()])
    return groups


def every_branch(folders: Sequence[Path], files: Files) -> list[Path]:
    """Return the files of all branches in ``folders`` that have a point; they are opened as ``files``."""
    # By their stems: a curve comes before those that were found from it, whose names go on with a hyphen.
    paths = [path for folder in folders for path in sorted(folder.glob("branch-*.h5"), key=lambda path: path.stem)]
    return [path for path in paths if has_points(open_branch(path, files))]


def _run_drawings(
    specs: Sequence[FigureSpec], folders: Sequence[Path], files: Files, records: Sequence[str]
) -> Iterator[Drawing]:
    """Yield every figure of the runs in ``folders``, whose analyses may be missing: of several runs, those of all."""
    opened = [run_and_analysis(folder, files) for folder in folders]
    names = [folder.name for folder in folders]
    if len(set(names)) < len(names):
        names = [str(folder) for folder in folders]
    if len(folders) == 1:
        names = [""]
    shown = [
        Shown(name, [run] if analysis is None else [run, analysis])
        for name, (run, analysis) in zip(names, opened, strict=True)
    ]

    for spec in specs:
        # The picture of several runs lies beside that of the first one.
        stem = in_file_name("-".join([spec.name, *filter(None, names[1:])]))
        if spec.together:
            yield Drawing(stem, warned(partial(spec.function, shown, records), shown), figure=spec.name)
        elif len(folders) == 1:
            yield Drawing(stem, warned(partial(spec.function, *opened[0]), shown, spec.without))
        elif len(specs) == 1:
            yield Drawing.without_picture(spec.name, "it shows one run; give one folder")


def run_and_analysis(folder: Path, files: Files) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Return the run in ``folder``, and its analysis if any; raise as ``open_run``."""
    run = files.get(folder / "run.h5", open_run)
    if not (folder / "analysis.h5").exists():
        return run, None
    return run, files.get(folder / "analysis.h5", partial(open_netcdf, kind="analysis"))


def _file_drawings(specs: Sequence[FigureSpec], folder: Path, files: Files) -> Iterator[Drawing]:
    """Yield every figure of ``specs`` from the one file in ``folder`` that has its results."""
    for spec in specs:
        data = result_of(spec.kind, folder, files)
        yield Drawing(spec.name, partial(spec.function, data))


def result_of(kind: ResultKind, folder: Path, files: Files) -> xr.Dataset:
    """Return the results of a ``kind`` in their one file in ``folder``, opened as one of the ``files``."""
    return files.get(folder / kind.file, partial(open_netcdf, kind=kind.source, needs=kind.needs))
