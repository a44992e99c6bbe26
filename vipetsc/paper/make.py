"""The whole paper in one folder: steps computed, figures drawn, claims measured, the report written.

Figures, claims and report are made again when the hash of their inputs has changed: the resolved cases of the steps,
the contents of their results, the version of the package. ``made.json`` keeps the hashes.
"""

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.io.folder import Claim, claimed, provenance
from vipetsc.io.kinds import PAPER
from vipetsc.paper.claims import write_claims
from vipetsc.paper.draw import draw_paper
from vipetsc.paper.paper_figures import RELATED, TRANSFER, PaperFigure
from vipetsc.paper.plan import DONE, MISSING, STALE, Plan, fingerprint, read_json
from vipetsc.paper.report import ReportContents, write_report
from vipetsc.paper.steps import FORMATS, BuildRecord, is_whole, make_steps, noted, read_record, rough_time, write_record
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.backbone import is_related, relate_folders
from vipetsc.wording import counted

Announce = Callable[[str], None]


@dataclass(frozen=True)
class PaperResult:
    """Outcome of a call: the ``new_steps`` computed, the files ``drawn``, the ``claims`` (rows of ``claims.json``).

    ``complete`` says that every step asked for is there, without failures. ``notes`` are warnings, and sentences about
    what failed and why.
    """

    new_steps: tuple[str, ...]
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
    tell: Announce = lambda text: None,
) -> PaperResult:
    """Compute what is missing or stale of ``plan`` in ``root``, on all ranks of ``comm``.

    Leaves ``<step>/`` for every step, ``figures/`` (PNG and PDF), ``claims.json`` and ``report.html``. The next
    call continues an interrupted one; a call with nothing to do takes seconds.

    ``only``, ids of figures and claims, restricts the steps and figures to those that they need; the claims are
    measured and the report is written from all finished steps. ``tell`` is called on rank 0 with what is about to be
    done.

    Raises FolderError if ``root`` holds the paper on another grid, or something else, or for an unknown id, CaseError
    if a case file cannot be used, StoppedError after a request to stop.
    """
    sys.audit("vipetsc.plan", str(root))
    root = Path(root)
    part = plan.only(only)
    with _claimed(plan, root, comm):
        return _make_paper(plan, part, root, comm, stop or StopRequest(), tell)


def _make_paper(plan: Plan, part: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Announce) -> PaperResult:
    """Compute the steps and figures of ``part``, then the claims and the report from all finished steps of ``plan``."""
    notes: list[str] = []
    new_steps = make_steps(part, root, comm, stop, tell, notes)
    stop.check(comm)

    # Figures and claims begin when all results are there: their inputs are hashes of the results.
    with noted(comm, "backbone", notes):
        on_root(comm, lambda: _relate(plan.folders(root)))
    inputs = on_root(comm, lambda: plan.inputs(root))
    # Stays empty if drawing fails, which ``noted`` notes.
    drawn: tuple[Path, ...] = ()
    with noted(comm, "figures", notes):
        drawn = draw_paper(part, root, comm, stop, tell, inputs)
    stop.check(comm)
    claims = on_root(comm, lambda: _conclude(plan, root, comm, tell, inputs["claims"]))

    # Steps may have failed, and are then still to be done.
    left = on_root(comm, lambda: part.left(root))
    failed = any(note.startswith("failed") for note in notes)
    return PaperResult(new_steps=new_steps, drawn=drawn, claims=claims, complete=not (left or failed), notes=notes)


def _claimed(plan: Plan, root: Path, comm: MPI.Comm) -> AbstractContextManager[Claim]:
    """Claim ``root`` for this plan; raises before anything is written, CaseError for a case that cannot be used."""
    for step in plan.steps:
        # For its error alone: the text is that of the resolved case.
        _ = step.text

    def difference(text: str) -> str | None:
        """Return the reason why ``plan.json`` with this ``text`` is of another plan; None if it is of this one."""
        try:
            grid = json.loads(text)["grid"]
        except (ValueError, KeyError):
            return f"its plan.json cannot be read; remove it if the folder holds the paper on the {plan.grid} grid"
        if grid == plan.grid:
            return None
        return f"holds the paper on the {grid} grid; choose another --out for the {plan.grid} one"

    return claimed(comm, root, PAPER, json.dumps({"grid": plan.grid}) + "\n", difference=difference)


def _relate(folders: Mapping[str, Path]) -> None:
    """Relate the transfer of the four-band lattice to the branches, as far as both are done (``backbone.h5``)."""
    branches = [folders[name] for name in RELATED if name in folders]
    if TRANSFER in folders and branches and not is_related(folders[TRANSFER], branches):
        relate_folders([folders[TRANSFER], *branches])


def _conclude(plan: Plan, root: Path, comm: MPI.Comm, tell: Announce, inputs: str) -> list[dict[str, Any]]:
    """Write ``claims.json`` and ``report.html`` if their inputs have changed; returns the claims. Called on one rank.

    ``inputs`` is the hash of what the claims are measured from.
    """
    # The record is written at the end: after a kill before that, the files are written again.
    record = read_record(root)
    path = root / "claims.json"
    if read_json(path) is None or record.get("claims") != inputs:
        tell("claims")
        sys.audit("vipetsc.claims")
        begin = time.process_time()
        write_claims(plan.measure(root, plan.unusable(root)), path)
        record["claims"] = inputs
        record["cpu"]["claims"] = time.process_time() - begin

    claims = path.read_text(encoding="utf-8")
    about = provenance(comm)
    versions = {key: value for key, value in about.items() if key.endswith("_version")}
    # Without the report's own time: if that were among its inputs, the report would never be up to date.
    cpu = {key: seconds for key, seconds in record["cpu"].items() if key != "report"}
    report_inputs = fingerprint(claims, json.dumps([inputs, record["figures"], versions, cpu]))
    if not is_whole(root / "report.html") or record.get("report") != report_inputs:
        tell("report")
        sys.audit("vipetsc.report")
        begin = time.process_time()
        contents = ReportContents(
            note=plan.note,
            claims=json.loads(claims),
            pictures=_pictures(plan, root, record),
            statistics={step.name: step.statistics(root) for step in plan.steps if step.state(root) == DONE},
            versions=about,
            cpu=cpu,
        )
        write_report(root / "report.html", contents)
        record["report"] = report_inputs
        record["cpu"]["report"] = time.process_time() - begin
    write_record(root, record)
    return json.loads(claims)


def _pictures(plan: Plan, root: Path, record: BuildRecord) -> list[tuple[PaperFigure, list[Path]]]:
    """Return the figures of the ``plan``, each with those of its pictures (PNG) that are there."""
    pictures = []
    for figure in plan.figures:
        stems = record["figures"].get(figure.id, {}).get("pictures", ())
        paths = [root / "figures" / f"{stem}.png" for stem in stems]
        pictures.append((figure, [path for path in paths if path.exists()]))
    return pictures


def plan_table(plan: Plan, root: Path, ranks: int) -> str:
    """Return a table of the steps and figures of ``plan``, with their state in ``root`` and time left on ``ranks``."""
    lines = [f"{'step':<26}{'state':<10}{'left':>9}  claims"]
    total = 0.0
    for step in plan.steps:
        left = step.left(root) / ranks
        total += left
        lines.append(f"{step.name:<26}{step.state(root):<10}{rough_time(left):>9}  {' '.join(plan.claims_of(step))}")
    all_steps = f"all steps on {counted(ranks, 'rank')}"
    lines += [f"{all_steps:<36}{rough_time(total):>9}", ""]

    width = max([len("paper"), *(len(figure.label) for figure in plan.figures)]) + 2
    lines.append(f"{'figure':<8}{'paper':<{width}}{'pictures':<10}{'state':<9}claims      shows")
    record = read_record(root)["figures"]
    inputs = plan.inputs(root)
    for figure in plan.figures:
        drawn, state = _figure_state(root, figure, record.get(figure.id), inputs[figure.id])
        row = f"{figure.id:<8}{figure.label:<{width}}{drawn:<10}{state:<9}{' '.join(figure.claims):<12}"
        lines.append(row + figure.title)
    return "\n".join(lines)


def _figure_state(root: Path, figure: PaperFigure, entry: BuildRecord | None, inputs: str) -> tuple[int, str]:
    """Return the number of existing pictures of a ``figure``, and whether they are those of its ``inputs``.

    ``entry`` is what is recorded of it, None if nothing is.
    """
    if entry is None:
        stems = {path.stem for path in (root / "figures").glob(f"{figure.id}-*")}
        entry = {"inputs": "", "pictures": stems}
    paths = [root / "figures" / f"{stem}.{kind}" for stem in entry["pictures"] for kind in FORMATS]
    files = sum(path.exists() for path in paths)
    if not files:
        state = MISSING
    # Every format of every picture: a kill may leave a PNG without its PDF.
    elif files == len(paths) and entry["inputs"] == inputs:
        state = DONE
    else:
        state = STALE
    return files // len(FORMATS), state
