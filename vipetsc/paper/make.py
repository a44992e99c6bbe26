"""The whole paper in one folder: steps made, figures drawn, claims measured, the report written."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc import figures
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing, draw_each
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import FolderError, provenance
from vipetsc.paper.figures import PaperFigure, words
from vipetsc.paper.plan import Plan
from vipetsc.paper.report import Picture, Report, Shown, write_report
from vipetsc.paper.steps import DONE, MISSING, STALE, newest
from vipetsc.parallel import SharedCounter, StopRequest, on_root

FORMATS = ("png", "pdf")
CODE = Path(figures.__file__).parent
PAPER = Path(__file__).parent
STAMP = "plan.json"  # which grid a folder holds
Tell = Callable[[str], None]


@dataclass(frozen=True)
class PaperResult:
    """What was done: steps ``made``, files ``drawn``; the rows of ``claims.json``.

    ``complete``: every step asked for is there, without failures. ``stopped``: it was asked to leave early.
    """

    made: tuple[str, ...]
    drawn: tuple[Path, ...]
    claims: tuple[dict[str, Any], ...]
    complete: bool
    stopped: bool
    folder: Path


def make_paper(
    plan: Plan,
    root: str | Path,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    only: Sequence[str] = (),
    stop: StopRequest | None = None,
    tell: Tell = lambda text: None,
) -> PaperResult:
    """Make what is missing or stale of ``plan`` in ``root``, on all ranks of ``comm``.

    Leaves ``<step>/`` for every step, ``figures/`` (PNG and PDF), ``claims.json`` and ``report.html``. A call that
    was stopped or killed is gone on with by the next one; one with nothing to do takes seconds.

    Parameters
    ----------
    only
        Ids of figures and claims: only the steps and figures that they need are made, and the claims measured and
        the report written from all that is there.
    tell
        Called on rank 0 with what is about to be done.

    Raises
    ------
    FolderError
        If ``root`` holds the paper on another grid, or something else, or for an unknown id.
    CaseError
        If a case file is not sound.
    """
    root, stop, part = Path(root), stop or StopRequest(), plan.only(only)
    on_root(comm, lambda: _claim(plan, root))
    made, stopped = [], False
    for step in part.steps:
        state = on_root(comm, lambda step=step: step.state(root))
        stopped = comm.allreduce(stop.requested, MPI.LOR)
        if stopped:
            break
        if state != DONE:
            on_root(comm, lambda step=step: tell(f"{step.name}: about {duration(step.left(root) / comm.size)}"))
            step.make(step.folder(root), comm, stop, state == STALE)
            made.append(step.name)
    if stopped or comm.allreduce(stop.requested, MPI.LOR):
        return PaperResult(tuple(made), (), (), False, True, root)
    if plan.relation:
        plan.relation.make(root, comm)
    drawn = draw_paper(part, root, comm, stop, tell)
    if comm.allreduce(stop.requested, MPI.LOR):
        return PaperResult(tuple(made), drawn, (), False, True, root)
    claims = on_root(comm, lambda: _conclude(plan, root, comm, tell))
    complete = on_root(comm, lambda: all(s.state(root) == DONE and s.sound(root) for s in part.steps))
    return PaperResult(tuple(made), drawn, claims, complete, False, root)


def draw_paper(plan: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Tell) -> tuple[Path, ...]:
    """Draw the figures that are missing or older than what they show; returns the files written, on all ranks.

    The ranks draw pictures from one count, so that they end together whatever a picture costs; none is begun after
    a request to stop.
    """
    folders = on_root(comm, lambda: plan.folders(root))
    since = on_root(comm, lambda: {plate.id: shown_since(plan, plate, root) for plate in plan.plates})
    target = root / "figures"
    on_root(comm, lambda: target.mkdir(exist_ok=True))
    on_root(comm, lambda: tell("figures"))
    offered: dict[str, list[str]] = {}

    def keep(path: Path) -> bool:
        return path.exists() and path.stat().st_mtime_ns >= since[path.name.partition("-")[0]]

    counter = SharedCounter(comm)

    def turns() -> Iterator[int]:
        while not stop.requested:
            yield counter.draw()

    with style.rc_style():
        drawings = _noted(plan.plates, folders, offered)
        own = draw_each(drawings, target, FORMATS, turns(), plan.note, keep)
    drawn = sorted(path for paths in comm.allgather(own) for path in paths)
    counter.free()
    on_root(comm, lambda: _note_pictures(target, offered))
    return tuple(drawn)


def _noted(plates: Sequence[PaperFigure], folders: Any, offered: dict[str, list[str]]) -> Iterator[Drawing]:
    """All pictures of ``plates``; ``offered`` gets their stems by plate."""
    for plate in plates:
        offered[plate.id] = []
        for stem, make in plate.offers(folders):
            offered[plate.id].append(stem)
            yield stem, make


def shown_since(plan: Plan, plate: PaperFigure, root: Path) -> int:
    """When what ``plate`` shows last changed, in ns: its data, or the code that draws it."""
    return max(*_written(CODE, "*.py"), newest((step for step in plan.steps if step.name in plate.steps), root))


def _note_pictures(target: Path, offered: dict[str, list[str]]) -> None:
    """Keep which pictures belong to which figure, and drop those that no data of this plan offer any more."""
    index = target / "index.json"
    known = json.loads(index.read_text(encoding="utf-8")) if index.exists() else {}
    for plate, stems in offered.items():
        for stem in set(known.get(plate, [])) - set(stems):
            for kind in FORMATS:
                (target / f"{stem}.{kind}").unlink(missing_ok=True)
    text = json.dumps(known | offered, indent=1) + "\n"
    if not index.exists() or index.read_text(encoding="utf-8") != text:
        write_text(index, text)


def pictures(root: Path) -> dict[str, list[str]]:
    """The stems of the pictures that belong into ``root``, by figure; empty before any was drawn."""
    index = root / "figures" / "index.json"
    return json.loads(index.read_text(encoding="utf-8")) if index.exists() else {}


def _conclude(plan: Plan, root: Path, comm: MPI.Comm, tell: Tell) -> tuple[dict[str, Any], ...]:
    """``claims.json`` and ``report.html`` as far as something is newer; returns the claims."""
    module = importlib.import_module(plan.claims)
    path, report = root / "claims.json", root / "report.html"
    if _older(path, [newest(plan.steps, root), *_written(Path(module.__file__).parent, "*.py")]):
        tell("claims")
        module.write_claims(module.measure_claims(root), path)
    claims = json.loads(path.read_text(encoding="utf-8"))
    if _older(report, _written(root, "claims.json", "figures/*.png") + _written(PAPER, "report.*", "figures.py")):
        tell("report")
        drawn = pictures(root)
        shown = []
        for plate in plan.plates:
            paths = [root / "figures" / f"{stem}.png" for stem in drawn.get(plate.id, [])]
            shown.append(Shown(plate, [Picture(path, words(path.stem)) for path in paths if path.exists()]))
        statistics = {s.name: s.statistics(root) for s in plan.steps if s.state(root) == DONE}
        write_report(Report(plan.note, claims, shown, statistics, provenance(comm)), report)
    return tuple(claims)


def _written(folder: Path, *patterns: str) -> list[int]:
    return [path.stat().st_mtime_ns for pattern in patterns for path in folder.glob(pattern)]


def _older(path: Path, times: list[int]) -> bool:
    """Whether ``path`` is missing, or older than any of ``times`` in ns."""
    return not path.exists() or path.stat().st_mtime_ns < max(times, default=0)


def _claim(plan: Plan, root: Path) -> None:
    """Make ``root`` the folder of this plan."""
    for step in plan.steps:
        _ = step.text  # an unsound case is said before anything is written
    if root.exists() and not root.is_dir():
        raise FolderError(f"{root}: is a file, not a folder; choose another --out")
    stamp = root / STAMP
    if stamp.exists():
        grid = "?"
        with suppress(ValueError, KeyError):
            grid = json.loads(stamp.read_text(encoding="utf-8"))["grid"]
        if grid != plan.grid:
            raise FolderError(
                f"{root}: holds the paper on the {grid} grid; choose another --out for the {plan.grid} one"
            )
    elif root.is_dir() and any(root.iterdir()) and all(s.state(root) in (MISSING, STALE) for s in plan.steps):
        raise FolderError(f"{root}: holds other files; choose another --out")
    root.mkdir(parents=True, exist_ok=True)
    if not stamp.exists():
        write_text(stamp, json.dumps({"grid": plan.grid}) + "\n")


def duration(seconds: float) -> str:
    """A time in words; a dash for none."""
    if seconds <= 0:
        return "-"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
