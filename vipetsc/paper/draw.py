"""Drawing the figures of the paper that are missing or were drawn from other results, on all ranks."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from mpi4py import MPI

from vipetsc.figures import style
from vipetsc.figures.style import Drawing, draw_each
from vipetsc.figures.sweep_members import Files
from vipetsc.paper.build_record import FORMATS, BuildRecord, is_drawn, read_record, write_record
from vipetsc.paper.plan import Plan
from vipetsc.parallel import SharedCounter, StopRequest, on_every_rank, on_root

MANY = 2**40  # more than any count


def draw_paper(
    plan: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Callable[[str], None], inputs: Mapping[str, str]
) -> tuple[Path, ...]:
    """Draw the figures that are missing or drawn from other ``inputs``; returns the files written, on all ranks.

    The ranks draw pictures from one count, the dearest first; none is begun after a request to stop.
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
        # Every rank opens the files and knows all pictures; which of them it draws is decided one by one.
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
        # Only if all pictures are new is their cost that of this call alone.
        drawn_anew = len(undrawn) == sum(len(entry["pictures"]) for entry in record["figures"].values())
        if not drawn_anew:
            # The cost of pictures from earlier calls counts, too.
            spent += record["cpu"]["figures"]
        record["cpu"]["figures"] = spent
    on_root(comm, lambda: write_record(root, record))
    return tuple(drawn)


def _draw_shared(drawings: Sequence[Drawing], root: Path, comm: MPI.Comm, stop: StopRequest, note: str) -> list[Path]:
    """Draw on all ranks, each the next picture that none has begun."""
    counter = SharedCounter(comm)

    def turns() -> Iterator[int]:
        while not stop.requested:
            yield counter.draw()
        counter.draw(MANY)  # so that no rank begins another

    try:
        written = on_every_rank(comm, lambda: draw_each(drawings, root / "figures", FORMATS, turns(), note))
    finally:
        # Collective, and reached by all ranks: ``on_every_rank`` raises on all of them or on none.
        counter.free()
    return sorted(path for paths in comm.allgather(written) for path in paths)


def _is_complete(key: str, record: BuildRecord, root: Path) -> bool:
    """Whether a figure's pictures are there, all of them."""
    stems = record["figures"][key]["pictures"]
    return bool(stems) and all(is_drawn(root, stem) for stem in stems)


def _drop_stale(plan: Plan, root: Path, inputs: Mapping[str, str]) -> BuildRecord:
    """Remove pictures of other ``inputs``, so that every picture that is there is up to date."""
    record = read_record(root)
    for figure in plan.figures:
        if record["figures"].get(figure.id, {}).get("inputs") != inputs[figure.id]:
            for path in (root / "figures").glob(f"{figure.id}-*"):
                # Before the record is written: after a kill between the two, the old record still names the old inputs.
                path.unlink()
            record["figures"][figure.id] = {"inputs": inputs[figure.id], "pictures": []}
    write_record(root, record)
    return record
