"""Drawing of the paper's figures on all ranks, as far as they are missing or were drawn from other results."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from mpi4py import MPI

from vipetsc.figures import style
from vipetsc.figures.style import Drawing, draw_each
from vipetsc.figures.sweep_members import Files
from vipetsc.paper.plan import Plan
from vipetsc.paper.steps import FORMATS, BuildRecord, is_drawn, read_record, write_record
from vipetsc.parallel import SharedCounter, StopRequest, on_every_rank, on_root

MANY = 2**40  # more than the number of pictures


def draw_paper(
    plan: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Callable[[str], None], inputs: Mapping[str, str]
) -> tuple[Path, ...]:
    """Draw the figures of ``plan`` in ``root`` that are missing or were drawn from other ``inputs``; returns the files.

    ``inputs`` are the hashes of what each figure is drawn from, by id (`Plan.inputs`). The ranks take one picture after
    the other from all that are to be drawn, the dearest first; none is begun after a request to stop. ``tell`` is
    called on rank 0 when drawing begins. Collective; all ranks get the same files.
    """
    begin = time.process_time()
    folders = on_root(comm, lambda: plan.folders(root))
    record = on_root(comm, lambda: _drop_stale(plan, root, inputs))
    missing = on_root(comm, lambda: [f for f in plan.figures if not _is_complete(f.id, record, root)])
    if not missing:
        return ()

    if comm.rank == 0:
        tell("figures")
    with Files() as files, style.rc_style():
        # Every rank opens the files and knows all pictures: which of them it will draw is not known yet.
        offers = on_every_rank(comm, lambda: {f.id: [*f.offers(folders, files)] for f in missing})
        for key, pictures in offers.items():
            record["figures"][key]["pictures"] = [picture.stem for picture in pictures]
        offered = [picture for pictures in offers.values() for picture in pictures]
        undrawn = on_root(comm, lambda: {p.stem for p in offered if not is_drawn(root, p.stem)})
        wanted = [picture for picture in offered if picture.stem in undrawn]
        wanted.sort(key=lambda picture: -picture.cost)  # the dearest first: ranks then end together
        drawn = _draw_shared([Drawing(p.stem, p.make) for p in wanted], root, comm, stop, plan.note)

    spent = comm.allreduce(time.process_time() - begin)
    if drawn:
        # Where some pictures stay that earlier calls drew, the time of those calls counts too.
        drawn_anew = len(undrawn) == sum(len(entry["pictures"]) for entry in record["figures"].values())
        if not drawn_anew:
            spent += record["cpu"]["figures"]
        record["cpu"]["figures"] = spent
    on_root(comm, lambda: write_record(root, record))
    return tuple(drawn)


def _draw_shared(drawings: Sequence[Drawing], root: Path, comm: MPI.Comm, stop: StopRequest, note: str) -> list[Path]:
    """Draw the ``drawings`` on all ranks, each the next picture that none has begun; returns the files, on all ranks.

    ``note`` is printed on every picture.
    """
    counter = SharedCounter(comm)

    def turns() -> Iterator[int]:
        while not stop.requested:
            yield counter.draw()
        # The count is then beyond all pictures, so that no other rank begins one either.
        counter.draw(MANY)

    try:
        written = on_every_rank(comm, lambda: draw_each(drawings, root / "figures", FORMATS, turns(), note))
    finally:
        # Collective, and reached by all ranks: ``on_every_rank`` raises on all of them or on none.
        counter.free()
    return sorted(path for paths in comm.allgather(written) for path in paths)


def _is_complete(key: str, record: BuildRecord, root: Path) -> bool:
    """Return whether all pictures of the figure ``key`` are there."""
    stems = record["figures"][key]["pictures"]
    return bool(stems) and all(is_drawn(root, stem) for stem in stems)


def _drop_stale(plan: Plan, root: Path, inputs: Mapping[str, str]) -> BuildRecord:
    """Remove the pictures that were drawn from other ``inputs``; returns the record without them."""
    record = read_record(root)
    for figure in plan.figures:
        if record["figures"].get(figure.id, {}).get("inputs") != inputs[figure.id]:
            for path in (root / "figures").glob(f"{figure.id}-*"):
                # Removed before the record is written: after a kill in between, the record still has the old inputs.
                path.unlink()
            record["figures"][figure.id] = {"inputs": inputs[figure.id], "pictures": []}
    write_record(root, record)
    return record
