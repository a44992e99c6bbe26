"""Why something has no picture: nothing is written for what cannot be drawn, and a message gives the reason."""

from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from vipetsc.figures import measure_pages, transfer_curves
from vipetsc.figures.registry import (
    BRANCH,
    OVER_BRANCHES,
    branches_by_name,
    every_branch,
    figure_names,
    figures_of,
    has_points,
    open_branch,
    result_of,
    run_and_analysis,
    specified_drawings,
    with_ensemble,
)
from vipetsc.figures.sources import BRANCHES, FILES, RUN, SWEEP
from vipetsc.figures.sweep_members import Files
from vipetsc.io.read import open_ensemble


def reasons_without_pictures(
    source: str, folders: Sequence[Path], files: Files, names: Sequence[str] | None = None
) -> dict[str, str]:
    """Return the reasons why figures of what the ``folders`` hold are not drawn, by name.

    The figures are those in ``names``, by default all; of sweeps by default measures, and the figure that shows
    branches too if ``folders`` hold any. A branch of which nothing is drawn has the name of its file. Results are
    opened as ``files``, and stay open for those who draw them. Raises KeyError as ``figure_names``, and ResultFileError
    for results with numbers that are not finite, or none, for which a reason cannot be given.
    """
    with files.naming_spoilt():
        reasons = _reasons(source, folders, files, names)
    return {name: reason for name, reason in reasons.items() if reason}


def _reasons(source: str, folders: Sequence[Path], files: Files, names: Sequence[str] | None) -> dict[str, str]:
    """Return the reason for each figure, empty for those that are drawn; see ``reasons_without_pictures``."""
    if source == SWEEP:
        return _reasons_of_sweeps(folders, files, names)

    reasons: dict[str, str] = {}
    if source == RUN:
        run, analysis = run_and_analysis(folders[0], files)
        specs = figures_of(source, folders)
        for name in figure_names(source, names, folders, files):
            without = specs[name].without
            reasons[name] = without(run, analysis) if without else ""
    elif source == BRANCHES:
        reasons = _reasons_of_branches(folders, files, names or ())
    elif source in FILES:
        specs = figures_of(source, folders)
        for name in figure_names(source, names, folders, files):
            without = specs[name].without
            reasons[name] = without(result_of(source, folders[0], files)) if without else ""
    return reasons


def _reasons_of_branches(folders: Sequence[Path], files: Files, names: Sequence[str]) -> dict[str, str]:
    """Return why branches of the first folder are not drawn, by the names of files, and why figures in ``names``."""
    reasons = {}
    for paths in branches_by_name(folders):
        drawn = all(has_points(open_branch(path, files)) for path in paths)
        reasons[paths[0].stem] = "" if drawn else "no point of the branch was computed"
    if reasons and all(reasons.values()):
        reasons = {BRANCH: "no branch has a point"}

    specs = figures_of(BRANCHES, folders)
    for name in names:
        spec = specs.get(name)
        if spec and spec.without:
            # The pictures that there would be, as the drawing has them.
            pictures = [every_branch(folders, files)] if spec.together else branches_by_name(folders)
            missing = []
            for paths in pictures:
                missing.append(spec.without([open_branch(path, files) for path in paths]))
            # The figure is missing only if it has not a single picture.
            if missing and all(missing):
                reasons[name] = missing[0]
    return reasons


def _reasons_of_sweeps(folders: Sequence[Path], files: Files, names: Sequence[str] | None) -> dict[str, str]:
    """Return why figures of the sweeps in ``folders`` are not drawn, by name."""
    expected = {*(names or ())}
    if len(with_ensemble(folders)) < len(folders) and names is None:
        expected.add(OVER_BRANCHES)
    reasons: dict[str, str] = {}
    specs = figures_of(SWEEP, folders)
    ensembles = [files.get(folder, open_ensemble) for folder in with_ensemble(folders)]
    for name in figure_names(SWEEP, names, folders, files):
        spec = specs.get(name)
        if spec:
            if name in expected and not any(specified_drawings(spec, ensembles, files)):
                unrelated = transfer_curves.curves_left_out(folders) if name == OVER_BRANCHES else ""
                reasons[name] = unrelated or f"needs {spec.needs}"
            continue

        by_sweep = [_reason(ensemble, name, by_name=names is not None) for ensemble in ensembles]
        # A measure that one of the sweeps has gives the figure pages.
        if all(by_sweep):
            reasons[name] = by_sweep[0]
    return reasons


def _reason(ensemble: xr.Dataset, name: str, by_name: bool) -> str:
    """Return why the measure whose pages have that ``name`` has none for an ensemble; empty where it has some."""
    for measure in measure_pages.measures_of(ensemble):
        if measure_pages.figure_name(measure) == name:
            return measure_pages.reason_without_page(ensemble, measure, by_name)
    return "the sweep does not measure it"
