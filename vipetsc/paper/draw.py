"""The figures of the paper drawn, as far as they are missing or were made from other results, on all ranks."""

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
    """Draw the figures that are missing or made of other ``inputs``; returns the files written, on all ranks.

    The ranks draw pictures from one count, the dearest first; none is begun after a request to stop.
    """
    begin = time.process_time()
    folders, record = on_root(comm, lambda: (plan.folders(root), _drop_stale(plan, root, inputs)))
    missing = on_root(comm, lambda: [f for f in plan.figures if not _is_complete(f.id, record, root)])
    if not missing:
        return ()
    if comm.rank == 0:
        tell("figures")
    with Files() as files, style.rc_style():
        offers = on_every_rank(comm, lambda: {f.id: [*f.offers(folders, files)] for f in missing})
        for key, pictures in offers.items():
            record["figures"][key]["pictures"] = [picture.stem for picture in pictures]
        undrawn = {stem for f in missing for stem in record["figures"][f.id]["pictures"]}
        undrawn = on_root(comm, lambda: {stem for stem in undrawn if not is_drawn(root, stem)})
        wanted = [picture for pictures in offers.values() for picture in pictures if picture.stem in undrawn]
        wanted.sort(key=lambda picture: -picture.cost)
        drawn = _draw_shared([Drawing(stem, make) for stem, make, _ in wanted], root, comm, stop, plan.note)
    spent = comm.allreduce(time.process_time() - begin)
    if drawn:
        every = len(undrawn) == sum(len(entry["pictures"]) for entry in record["figures"].values())
        record["cpu"]["figures"] = spent + (0.0 if every else record["cpu"]["figures"])
    on_root(comm, lambda: write_record(root, record))
    return tuple(drawn)


def _draw_shared(drawings: Sequence[Drawing], root: Path, comm: MPI.Comm, stop: StopRequest, note: str) -> list[Path]:
    """Draw on all ranks, each the next one that none has begun."""
    counter = SharedCounter(comm)

    def turns() -> Iterator[int]:
        while not stop.requested:
            yield counter.draw()
        counter.draw(MANY)  # so that no rank begins another

    try:
        mine = on_every_rank(comm, lambda: draw_each(drawings, root / "figures", FORMATS, turns(), note))
    finally:
        counter.free()
    return sorted(path for paths in comm.allgather(mine) for path in paths)


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
                path.unlink()
            record["figures"][figure.id] = {"inputs": inputs[figure.id], "pictures": []}
    write_record(root, record)
    return record
