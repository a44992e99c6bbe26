"""The whole paper in one folder: steps made, figures drawn, claims measured, the report written.

What is made from results is made again when the hash of its inputs changed: the steps' resolved cases, the contents of
their results, the version of the package. ``made.json`` keeps the hashes.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.figures import style
from vipetsc.figures.style import Drawing, draw_each
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import PAPER, Claim, claimed, provenance
from vipetsc.paper.claims import write_claims
from vipetsc.paper.figures import RELATED, TRANSFER
from vipetsc.paper.plan import DONE, MISSING, STALE, Plan, Step, fingerprint, read_json
from vipetsc.paper.report import write_report
from vipetsc.parallel import SharedCounter, StoppedError, StopRequest, on_every_rank, on_root
from vipetsc.studies.backbone import is_related, relate_folders
from vipetsc.studies.pool import FULL

FORMATS = ("png", "pdf")
LAST = {".png": b"IEND", ".pdf": b"%%EOF", ".html": b"</html>"}  # what such files end with
MANY = 2**40  # more than any count
MADE = "made.json"
Tell = Callable[[str], None]
Record = dict[str, Any]
"""Of ``made.json``: hashes of inputs of "claims" and "report", of "figures" by id with the stems of their pictures."""


@dataclass(frozen=True)
class PaperResult:
    """What was done: steps ``made``, files ``drawn``; the rows of ``claims.json``.

    ``complete``: every step asked for is there, without failures; ``notes`` are warnings, and say what failed and why.
    """

    made: tuple[str, ...]
    drawn: tuple[Path, ...]
    claims: list[dict[str, Any]]
    complete: bool
    notes: list[str]


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

    ``only``, ids of figures and claims, makes only the steps and figures that they need; the claims are measured and
    the report is written from all that is there. ``tell`` is called on rank 0 with what is about to be done.

    Raises FolderError if ``root`` holds the paper on another grid, or something else, or for an unknown id, CaseError
    if a case file cannot be used, StoppedError after a request to stop.
    """
    sys.audit("vipetsc.plan", str(root))
    root, part = Path(root), plan.only(only)
    with _claimed(plan, root, comm):
        return _make_paper(plan, part, root, comm, stop or StopRequest(), tell)


def _make_paper(plan: Plan, part: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Tell) -> PaperResult:
    """Make the steps and figures of ``part``, and from all of ``plan`` that is there the claims and the report."""
    notes: list[str] = []
    made = _make_steps(part, root, comm, stop, tell, notes)
    stop.check(comm)
    with _noted(comm, "backbone", notes):
        on_root(comm, lambda: _relate(plan.folders(root)))
    drawn: tuple[Path, ...] = ()
    with _noted(comm, "figures", notes):
        drawn = draw_paper(part, root, comm, stop, tell)
    stop.check(comm)
    claims = on_root(comm, lambda: _conclude(plan, root, comm, tell))

    def is_complete(step: Step) -> bool:
        state, _, failures = _progress(step, root)
        return state == DONE and not failures

    complete = on_root(comm, lambda: all(map(is_complete, part.steps)))
    return PaperResult(made, drawn, claims, complete and not any(note.startswith("failed") for note in notes), notes)


@contextmanager
def _noted(comm: MPI.Comm, name: str, notes: list[str]) -> Iterator[None]:
    """Note what is raised and go on; not where one rank failed alone, nor for a full disk."""
    try:
        yield
    except StoppedError:
        raise
    except Exception as error:
        alone = comm.size > 1 and not getattr(error, "from_root", False)
        if alone or getattr(error, "errno", None) in FULL:
            raise
        notes.append(f"failed: {name}: {error or type(error).__name__}")


def _claimed(plan: Plan, root: Path, comm: MPI.Comm) -> AbstractContextManager[Claim]:
    """Claim ``root`` for this plan; a case that cannot be used raises before anything is written."""
    for step in plan.steps:
        _ = step.text

    def difference(text: str) -> str | None:
        with suppress(ValueError, KeyError):
            grid = json.loads(text)["grid"]
            other = f"holds the paper on the {grid} grid; choose another --out for the {plan.grid} one"
            return other if grid != plan.grid else None
        return f"its plan.json cannot be read; remove it if the folder holds the paper on the {plan.grid} grid"

    return claimed(comm, root, PAPER, json.dumps({"grid": plan.grid}) + "\n", difference=difference)


def _progress(step: Step, root: Path) -> tuple[str, float, int]:
    """State of a step, CPU time in s that is left, and how many of its members or branches failed."""
    state = step.state(root)
    return state, step.left(root), step.failures(root) if state == DONE else 0


def _make_steps(
    plan: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Tell, notes: list[str]
) -> tuple[str, ...]:
    """Make the steps that are not done or had failures, until a request to stop; returns their names."""
    made = []
    for step in plan.steps:
        state, left, failures = on_root(comm, partial(_progress, step, root))
        if stop.agreed(comm):
            break
        if state != DONE or failures:
            if comm.rank == 0:
                tell(f"{step.name}: about {duration(left / comm.size)}")
            with _noted(comm, step.name, notes):
                sys.audit("vipetsc.member", step.name)
                warnings = step.make(root, comm, stop, state == STALE)
                notes += [f"warning: {step.name}: {warning}" for warning in warnings]
                made.append(step.name)
    return tuple(made)


def _relate(folders: Mapping[str, Path]) -> None:
    """Lay the transfer of the four-band lattice over the branches, as far as they are done (``backbone.h5``)."""
    branches = [folders[name] for name in RELATED if name in folders]
    if TRANSFER in folders and branches and not is_related(folders[TRANSFER], branches):
        relate_folders([folders[TRANSFER], *branches])


def draw_paper(plan: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Tell) -> tuple[Path, ...]:
    """Draw the figures that are missing or stale; returns the files written, on all ranks.

    The ranks draw pictures from one count, so that they end together whatever a picture costs; none is begun after
    a request to stop.
    """
    folders, record = on_root(comm, lambda: (plan.folders(root), _drop_stale(plan, root)))
    if comm.rank == 0:
        tell("figures")
    counter = SharedCounter(comm)

    def turns() -> Iterator[int]:
        while not stop.requested:
            yield counter.draw()
        counter.draw(MANY)  # so that no rank begins another

    def offered() -> Iterator[Drawing]:
        for figure in plan.figures:
            entry = record["figures"][figure.id]
            entry["pictures"] = []
            for stem, make in figure.offers(folders):
                entry["pictures"].append(stem)
                yield stem, make

    def draw_share() -> list[Path]:
        with style.rc_style():
            return draw_each(offered(), root / "figures", FORMATS, turns(), plan.note, keep=_is_whole)

    try:
        mine = on_every_rank(comm, draw_share)
    finally:
        counter.free()
    drawn = sorted(path for paths in comm.allgather(mine) for path in paths)
    on_root(comm, lambda: _write_record(root, record))
    return tuple(drawn)


def _is_whole(path: Path) -> bool:
    """Whether a picture or page is there to its end."""
    return path.exists() and LAST[path.suffix] in path.read_bytes()[-32:]


def _drop_stale(plan: Plan, root: Path) -> Record:
    """Remove pictures of other inputs than those of now, so that every picture that is there is up to date."""
    record, inputs = read_record(root), plan.inputs(root)
    for figure in plan.figures:
        if record["figures"].get(figure.id, {}).get("inputs") != inputs[figure.id]:
            for path in (root / "figures").glob(f"{figure.id}-*"):
                path.unlink()
            record["figures"][figure.id] = {"inputs": inputs[figure.id], "pictures": []}
    _write_record(root, record)
    return record


def read_record(root: Path) -> Record:
    """``made.json``, or an empty record, after which everything is made again."""
    return read_json(root / MADE) or {"figures": {}}


def _write_record(root: Path, record: Record) -> None:
    if record != read_record(root):
        write_text(root / MADE, json.dumps(record, indent=1) + "\n")


def _conclude(plan: Plan, root: Path, comm: MPI.Comm, tell: Tell) -> list[dict[str, Any]]:
    """``claims.json`` and ``report.html`` as far as their inputs changed; returns the claims."""
    record, inputs = read_record(root), plan.inputs(root)["claims"]
    path, report = root / "claims.json", root / "report.html"
    if read_json(path) is None or record.get("claims") != inputs:
        tell("claims")
        sys.audit("vipetsc.claims")
        write_claims(plan.measure(root), path)
        record["claims"] = inputs
    text = path.read_text(encoding="utf-8")
    versions = {key: value for key, value in provenance(comm).items() if key.endswith("_version")}
    inputs = fingerprint(text, json.dumps([inputs, record["figures"], versions]))
    if not _is_whole(report) or record.get("report") != inputs:
        tell("report")
        sys.audit("vipetsc.report")
        stems = {key: entry["pictures"] for key, entry in record["figures"].items()}
        paths = [[root / "figures" / f"{stem}.png" for stem in stems.get(f.id, ())] for f in plan.figures]
        pictures = [(f, list(filter(Path.exists, ps))) for f, ps in zip(plan.figures, paths, strict=True)]
        statistics = {step.name: step.statistics(root) for step in plan.steps if step.state(root) == DONE}
        write_report(report, plan.note, json.loads(text), pictures, statistics, versions)
        record["report"] = inputs
    _write_record(root, record)
    return json.loads(text)


def duration(seconds: float) -> str:
    """A time in words; a dash for none."""
    if seconds <= 0:
        return "-"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def plan_table(plan: Plan, root: Path, ranks: int) -> str:
    """What is done and what is left of ``plan`` in ``root``: steps with the time they need, figures, claims."""
    lines, total = [f"{'step':<26}{'state':<10}{'left':>9}  claims"], 0.0
    for step in plan.steps:
        left = step.left(root) / ranks
        total += left
        lines.append(f"{step.name:<26}{step.state(root):<10}{duration(left):>9}  {' '.join(plan.claims_of(step))}")
    lines += [f"{'all steps on ' + str(ranks) + (' ranks' if ranks > 1 else ' rank'):<36}{duration(total):>9}", ""]
    lines.append(f"{'figure':<8}{'paper':<9}{'pictures':<10}{'state':<9}claims      shows")
    record, inputs = read_record(root)["figures"], plan.inputs(root)
    for figure in plan.figures:
        unrecorded = {path.stem for path in (root / "figures").glob(f"{figure.id}-*")}
        entry = record.get(figure.id, {"inputs": "", "pictures": unrecorded})
        paths = [root / "figures" / f"{stem}.{kind}" for stem in entry["pictures"] for kind in FORMATS]
        drawn = sum(path.exists() for path in paths)
        current = drawn == len(paths) and entry["inputs"] == inputs[figure.id]
        state = MISSING if not drawn else DONE if current else STALE
        row = f"{figure.id:<8}{figure.label:<9}{drawn // len(FORMATS):<10}{state:<9}{' '.join(figure.claims):<12}"
        lines.append(row + figure.title)
    return "\n".join(lines)
