"""Pictures of the results in a folder, drawn from its files on all ranks."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from mpi4py import MPI

from vipetsc.cli.messages import echo
from vipetsc.figures.loading import load_matplotlib
from vipetsc.figures.second_process import Drawn, DrawRequest, SecondProcess
from vipetsc.io.errors import is_disk_full
from vipetsc.io.folder import FolderError
from vipetsc.io.netcdf import root_attributes
from vipetsc.parallel import on_every_rank, on_root

if TYPE_CHECKING:
    from vipetsc.figures.sweep_members import Files

MEASURES = "analysis.h5"  # the file of a run's measures, which `Pictures.prepare` writes
SWEEP_FIGURES = "sweep"  # the name in the registry of the pictures of sweeps


class Helper(Protocol):
    """A process, or ranks, that draw pictures while this process computes.

    There are `vipetsc.figures.second_process.SecondProcess` and `vipetsc.cli.helping_ranks.HelpingRanks`.
    """

    @property
    def draws_alone(self) -> bool:
        """Whether the helper draws on all cores once this process waits for it, which then need not draw."""

    @property
    def requests(self) -> Sequence[DrawRequest]:
        """The requests for which `drawn` has not waited: this process can draw pictures that are left of them."""

    def ask(self, source: str, folders: Sequence[Path], **options: Any) -> None:
        """Ask for what ``vipetsc.figures.registry.draw`` draws with these arguments; returns at once."""

    def drawn(self) -> Drawn | None:
        """Wait for all that was asked for; None if it failed and all is to be drawn here."""


@dataclass(frozen=True)
class Pictures:
    """Pictures that a verb draws of its results.

    ``source`` is the name of these pictures in the registry of figures. ``file`` is the name of the file of results (a
    pattern as of ``Path.glob``): a folder that has it can be drawn; ``noun`` says what the file is. ``prepare`` checks
    folders before they are drawn, and measures what is missing in them or older than its run; without it, the drawing
    finds out which file cannot be read. ``recognise`` says whether folders hold such results, where that takes more
    than one ``file`` in one folder. ``unmeasured`` are figures that show the ``file`` alone, without its measures, and
    can be drawn while these are taken.
    """

    source: str
    file: str
    noun: str
    prepare: Callable[[Sequence[Path]], None] | None = None
    recognise: Callable[[Sequence[Path]], bool] | None = None
    unmeasured: tuple[str, ...] = ()

    def are_of(self, folders: Sequence[Path]) -> bool:
        """Whether these pictures show the results in ``folders``."""
        if self.recognise:
            return self.recognise(folders)
        return len(folders) == 1 and any(folders[0].glob(self.file))


def second_process(
    pictures: Pictures, comm: MPI.Comm, draws_alone: bool, names: Sequence[str] | None = None
) -> AbstractContextManager[SecondProcess | None]:
    """A second process for ``pictures``, or None where it is of no use; as a context.

    It is of use for pictures that take long, those of a run that are not restricted to ``names``, and where this
    process is the only rank of ``comm`` and a core is idle. ``draws_alone`` should be true if this process computes
    first: the second one has then loaded matplotlib by the time that there are results. If this process has only
    pictures to draw, both should draw, since the second one has yet to begin.
    """
    if pictures.unmeasured and not names and comm.size == 1 and SecondProcess.is_useful():
        return SecondProcess(draws_alone)
    return nullcontext()


def draw_unmeasured(pictures: Pictures, folder: Path, helper: Helper) -> None:
    """Ask the ``helper`` for the pictures of new results in ``folder`` that need no measures, while these are taken."""
    # A picture carries the warnings of the measures in its folder, and those of earlier results would be wrong.
    if not (folder / MEASURES).exists():
        helper.ask(pictures.source, [folder], names=pictures.unmeasured)


def draw_pictures(
    pictures: Pictures,
    folders: Sequence[Path],
    comm: MPI.Comm,
    names: list[str] | None = None,
    formats: tuple[str, ...] = ("png",),
    afresh: bool = True,
    helper: Helper | None = None,
) -> list[Path]:
    """Draw the ``pictures`` of ``folders`` on all ranks; results without measures, or newer than these, are measured.

    ``names`` are the figures to draw, all by default. Unless ``afresh``, pictures stay that are newer than the files
    that they show. A ``helper``, which may have been asked to `draw_unmeasured`, draws too, or alone. Returns the files
    written on rank 0, and an empty list on the others. Raises FolderError for folders that hold nothing to draw, and
    for a figure that does not exist. Collective.
    """
    on_root(comm, lambda: prepare(pictures, folders, names))
    # Rank 0 reads the time, so that all ranks use the same one even if their file systems differ.
    newest = None
    if not afresh:
        newest = on_root(comm, lambda: newest_result(folders))

    if helper:
        ask_for_rest(pictures, folders, helper, formats=formats, newest=newest)
        if helper.draws_alone:
            # This process does not even load matplotlib, unless the helper has failed.
            if drawn := helper.drawn():
                report(pictures, comm, sentences_on(drawn.reasons))
                return sorted(marked_as_new(drawn.files))
            helper = None

    load_matplotlib()
    from vipetsc.figures.registry import draw
    from vipetsc.figures.sweep_members import Files

    def draw_part() -> list[Path]:
        with reading(pictures, folders):
            if helper:
                here = [draw(**request.options, turns=request.turns, files=files) for request in helper.requests]
                by_helper = helper.drawn()
                if by_helper:
                    return [*chain.from_iterable(here), *marked_as_new(by_helper.files)]
            # Without a helper, or if it has failed, all pictures are drawn here.
            turns = count(comm.rank, comm.size)
            return draw(pictures.source, folders, names, formats, newest=newest, files=files, turns=turns)

    # What is left out and what is drawn is read from the same results, which are opened once.
    with Files() as files:
        report(pictures, comm, on_root(comm, lambda: left_out(pictures, folders, files, names)))
        drawn_here = on_every_rank(comm, draw_part)
    # ``gather`` returns None on all ranks but the first.
    return sorted(path for paths in comm.gather(drawn_here) or [] for path in paths)


def ask_for_rest(pictures: Pictures, folders: Sequence[Path], helper: Helper, **options: Any) -> None:
    """Ask the ``helper`` for those of the ``pictures`` that it was not asked to `draw_unmeasured`."""
    # Pictures that were drawn before the measures lack their warnings. If there are any, all pictures are drawn when
    # none of the earlier ones is being drawn any more.
    if helper.requests and measures_warn(folders[0]):
        helper.drawn()
    drawn_ahead: tuple[str, ...] = ()
    if helper.requests:
        drawn_ahead = pictures.unmeasured
    helper.ask(pictures.source, folders, omit=drawn_ahead, **options)


def marked_as_new(pictures: Sequence[Path]) -> Sequence[Path]:
    """Give the files of ``pictures`` the present time, and return them.

    Some are older than the measures, which have no warning for them. A later call, which compares times, must not draw
    them again.
    """
    for path in pictures:
        path.touch()
    return pictures


def report(pictures: Pictures, comm: MPI.Comm, sentences: Sequence[str]) -> None:
    """Print ``sentences`` about pictures that are left out, on rank 0."""
    for sentence in sentences:
        if pictures.source == SWEEP_FIGURES:
            echo(comm, f"vipetsc: {sentence}", sys.stderr)
        else:
            # No warning: a lattice without sites, for example, has no picture of impacts.
            echo(comm, f"  {sentence}")


def measures_warn(folder: Path) -> bool:
    """Whether the measures in ``folder`` carry warnings, which stand below every picture."""
    return bool(json.loads(root_attributes(folder / MEASURES, "analysis")["warnings"]))


@contextmanager
def reading(pictures: Pictures, folders: Sequence[Path]) -> Iterator[None]:
    """Turn errors of reading within the block into a FolderError, unless ``pictures.prepare`` has checked the file."""
    try:
        yield
    except FolderError:
        # The message says which file, and why.
        raise
    except (OSError, KeyError, ValueError) as error:
        # After a check by `prepare` an error is one of the program. A full disk says nothing about the file.
        if pictures.prepare or is_disk_full(error):
            raise
        article = "an" if pictures.noun[0] in "aeiou" else "a"
        path = folders[0] / pictures.file
        raise FolderError(f"{path}: is not {article} {pictures.noun} of vipetsc ({error})") from None


def prepare(pictures: Pictures, folders: Sequence[Path], names: list[str] | None = None) -> None:
    """Check the figures ``names``, and take measures that are missing or older than their run; on one rank.

    Raises FolderError for a figure that does not exist, before any file is written, and as ``pictures.prepare``.
    """
    # Names first: measuring writes files, and a wrong --fig must leave none.
    if names is not None:
        # First by this function, which loads matplotlib without its help texts: the registry would load these too.
        load_matplotlib()
        from vipetsc.figures.registry import figure_names

        try:
            figure_names(pictures.source, names, folders)
        except KeyError as error:
            raise FolderError(f"--fig: {error.args[0]}") from None
    if pictures.prepare:
        pictures.prepare(folders)


def left_out(pictures: Pictures, folders: Sequence[Path], files: "Files", names: list[str] | None) -> list[str]:
    """Sentences about pictures that the results do not allow; on one rank, which opens results through ``files``.

    Raises FolderError if a figure among ``names`` is one of them.
    """
    from vipetsc.figures.registry import OVER_BRANCHES
    from vipetsc.figures.transfer_curves import curves_left_out
    from vipetsc.figures.without_picture import reasons_without_pictures

    with reading(pictures, folders):
        reasons = reasons_without_pictures(pictures.source, folders, files, names)
    asked = [name for name in names or () if name in reasons]
    if asked:
        missing = "; ".join(f"--fig {name}: {reasons[name]}" for name in asked)
        raise FolderError(f"{folders[0]}: {missing}")
    sentences = sentences_on(reasons)
    if pictures.source != SWEEP_FIGURES:
        return sentences

    # Only one page shows branches, and perhaps not all curves of the sweep.
    branches = [str(folder) for folder in folders if not (folder / "ensemble.h5").exists()]
    if branches and names and OVER_BRANCHES not in names:
        drawn = ", ".join(names)
        sentences.append(f"{drawn}: without the branches of {', '.join(branches)}; --fig {OVER_BRANCHES} draws both")
    elif branches and OVER_BRANCHES not in reasons and (unrelated := curves_left_out(folders)):
        sentences.append(f"{OVER_BRANCHES}: without {unrelated}")
    return sentences


def sentences_on(reasons: Mapping[str, str]) -> list[str]:
    """Sentences about figures that are left out, from the ``reasons`` by name."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        by_reason.setdefault(reason, []).append(name)
    return [f"no picture of {', '.join(named)}: {reason}" for reason, named in by_reason.items()]


def newest_result(folders: Sequence[Path]) -> float:
    """Time, as ``st_mtime``, at which the newest file of results in ``folders`` was written."""
    return max(path.stat().st_mtime for folder in folders for path in folder.glob("*.h5"))
