"""Follow all branches of a case, distributed over ranks, into a folder that is claimed for them."""

from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import NnmCase
from vipetsc.io.folder import BRANCHES, Claim, claimed, provenance
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follower import BranchCase, Follower, method_of
from vipetsc.modes.branches.growth import Listener
from vipetsc.modes.shared_frequencies import check_modes_alone
from vipetsc.parallel import StopRequest, on_every_rank, on_root


def claim_branches(
    case: BranchCase, folder: Path, comm: MPI.Comm, force: bool = False, resume: bool = False
) -> AbstractContextManager[Claim]:
    """Claim ``folder`` for the branches of ``case``, as ``claimed``.

    With ``resume`` the case must have the physics of the earlier one (``physics`` of its class). It may differ in what
    does not move a branch: steps, bounds, and numbers of points and of Newton steps. A branch that reached a bound is
    complete: a wider bound does not lengthen it. Raises CaseError, before anything is written, for a mode that shares
    its frequency with others.
    """
    if isinstance(case, NnmCase):
        on_root(comm, lambda: check_modes_alone(case))

    def difference(earlier: str) -> str | None:
        # A branch that has used up its points is resumed with a case that allows more of them.
        if type(case).from_toml(earlier).physics() == case.physics():
            return None
        return f"--resume needs {case.kept_by_resume}"

    text = case.to_toml()
    if not resume:
        return claimed(comm, folder, BRANCHES, text, force=force)
    return claimed(comm, folder, BRANCHES, text, force=force, resume=True, difference=difference)


def follow_all(
    case: BranchCase,
    folder: Path | None,
    comm: MPI.Comm,
    resume: bool = False,
    listener: Listener | None = None,
    stop: StopRequest | None = None,
) -> list[Branch[Any]]:
    """All branches of ``case``, written into ``folder`` if there is one.

    Each branch is computed on one rank, so that its bits do not depend on the number of ranks: rank r of n follows the
    branches r, r + n, r + 2n and so on. Where a lattice is shot without dense matrices, all ranks follow one branch
    together, and then the next one.

    A branch that fails, by one of ``Method.failures``, is written as far as it came and says why (``Branch.ended``),
    and the others go on. A ``stop`` ends each branch at its next point, or earlier if an orbit's search takes long
    (``ArcLimits``); of branches that are not begun yet each still computes its start, unless that takes long or has
    steps of its own, and one point. With ``resume`` branches that were stopped go on to the same bits, and branches
    that failed or have used up their points go on from their last point. Returns all branches on rank 0, in the order
    of the case; an empty list on the others.

    Any other error of one rank, as where a file cannot be written, is raised on all ranks once the others have followed
    their branches. Where all ranks follow one branch together, an error that one of them has alone leaves the others
    waiting, unless it ends them too (``parallel.install_abort_hook``).
    """
    if not isinstance(case, BranchCase):
        raise TypeError(f"follow_all takes a case of the class NnmCase or NfrcCase, not {type(case).__name__}")
    follower = partial(Follower, case, folder, provenance(comm), listener, stop, resume)
    jobs = method_of(case).jobs(case)
    # Collective calls inside: every rank follows the same branches in the same order.
    if method_of(case).shared:
        together = follower(comm)
        branches = [branch for job in jobs for branch in together.follow(job)]
        if comm.rank > 0:
            return []
        return branches

    # Neighbours in the list fall to different ranks; no rank waits for another until all are followed.
    numbers = range(comm.rank, len(jobs), comm.size)

    def follow_alone() -> dict[int, list[Branch[Any]]]:
        if not numbers:
            return {}
        alone = follower(comm=MPI.COMM_SELF)
        return {number: alone.follow(jobs[number]) for number in numbers}

    followed = on_every_rank(comm, follow_alone)
    # ``gather`` returns None on the other ranks.
    by_number: dict[int, list[Branch[Any]]] = {}
    for of_rank in comm.gather(followed) or []:
        by_number |= of_rank
    return [branch for number in sorted(by_number) for branch in by_number[number]]
