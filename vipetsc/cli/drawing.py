"""Pictures of the results in a folder, drawn from its files on all ranks."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from vipetsc.cli.messages import echo, echo_warnings
from vipetsc.io.errors import is_of_file_system
from vipetsc.io.folder import FolderError
from vipetsc.io.kinds import BRANCHES, SWEEP, ResultKind
from vipetsc.parallel import on_every_rank, on_root

if TYPE_CHECKING:
    from mpi4py import MPI

    from vipetsc.figures.look import Look
    from vipetsc.figures.style import LeftOut


@dataclass(frozen=True)
class Pictures:
    """Pictures that a verb draws of its results, which are of a ``kind``.

    A folder that has the file of this kind can be drawn. ``prepare`` checks folders before they are drawn, and measures
    what is missing in them or older than its run; without it, the drawing finds out which file cannot be read.
    ``recognise`` says whether folders hold such results, where that takes more than one file in one folder.
    """

    kind: ResultKind
    prepare: Callable[[Sequence[Path]], None] | None = None
    recognise: Callable[[Sequence[Path]], bool] | None = None

    def are_of(self, folders: Sequence[Path]) -> bool:
        """Return whether these pictures show the results in ``folders``."""
        if self.recognise:
            return self.recognise(folders)
        return len(folders) == 1 and any(folders[0].glob(self.kind.file))


def draw_pictures(
    pictures: Pictures,
    folders: Sequence[Path],
    comm: "MPI.Comm",
    names: list[str] | None = None,
    formats: tuple[str, ...] = ("png",),
    afresh: bool = True,
    look: "Look | None" = None,
    records: Sequence[str] = (),
) -> list[Path]:
    """Draw the ``pictures`` of ``folders`` on all ranks; results without measures, or newer than these, are measured.

    ``names`` are the figures to draw, all by default. Unless ``afresh``, pictures stay that are newer than the files
    that they show. ``look`` and ``records`` are as for ``figures.registry.draw``. Returns the files written on rank 0,
    and an empty list on the others. Raises FolderError for folders that hold nothing to draw, and for a figure that
    does not exist. Collective.
    """
    on_root(comm, lambda: prepare(pictures, folders, names))
    # Rank 0 reads the time, so that all ranks use the same one even if their file systems differ.
    newest = None
    if not afresh:
        newest = on_root(comm, lambda: newest_result(folders))

    # Imported here: a run without pictures does not load matplotlib.
    from vipetsc.figures.registry import draw
    from vipetsc.figures.style import LeftOut

    left_out = LeftOut()

    def draw_part() -> list[Path]:
        # Pictures are listed by falling duration, so that ranks which take them in turn end at about the same time.
        turns = count(comm.rank, comm.size)
        with reading(pictures, folders):
            return draw(
                pictures.kind.source,
                folders,
                names,
                formats,
                newest=newest,
                turns=turns,
                left_out=left_out,
                look=look,
                records=records,
            )

    drawn_here = on_every_rank(comm, draw_part)

    # ``gather`` returns None on all ranks but the first.
    for other in comm.gather(left_out) or []:
        left_out.add(other)
    report(pictures, comm, on_root(comm, lambda: sentences_on(pictures, folders, left_out, names)))
    labelled = on_root(comm, lambda: left_out.labelled)
    if look and (unknown := [text for text in look.labels if text not in labelled]):
        echo_warnings(comm, [f"--label {', '.join(unknown)}: no picture that was drawn has this text or key"])
    return sorted(path for paths in comm.gather(drawn_here) or [] for path in paths)


def report(pictures: Pictures, comm: "MPI.Comm", sentences: Sequence[str]) -> None:
    """Print ``sentences`` about pictures that are left out, on rank 0."""
    for sentence in sentences:
        if pictures.kind == SWEEP:
            echo(comm, f"vipetsc: {sentence}", sys.stderr)
        else:
            # No warning: a lattice without sites, for example, has no picture of impacts.
            echo(comm, f"  {sentence}")


@contextmanager
def reading(pictures: Pictures, folders: Sequence[Path]) -> Iterator[None]:
    """Turn errors of reading within the block into a FolderError, unless ``pictures.prepare`` has checked the file."""
    try:
        yield
    except FolderError:
        # The message says which file, and why.
        raise
    except (OSError, KeyError, ValueError) as error:
        # After a check by `prepare` an error is one of the program. One of the file system is not about it.
        if pictures.prepare or is_of_file_system(error):
            raise
        article = "an" if pictures.kind.noun[0] in "aeiou" else "a"
        path = folders[0] / pictures.kind.file
        raise FolderError(f"{path}: is not {article} {pictures.kind.noun} of vipetsc ({error})") from None


def prepare(pictures: Pictures, folders: Sequence[Path], names: list[str] | None = None) -> None:
    """Check the figures ``names``, and take measures that are missing or older than their run; on one rank.

    Raises FolderError for a figure that does not exist, before any file is written, and as ``pictures.prepare``.
    """
    # Names first: measuring writes files, and a wrong --fig must leave none.
    if names is not None:
        from vipetsc.figures.registry import figure_names

        try:
            figure_names(pictures.kind.source, names, folders)
        except KeyError as error:
            raise FolderError(f"--fig: {error.args[0]}") from None
    if pictures.prepare:
        pictures.prepare(folders)


def sentences_on(
    pictures: Pictures, folders: Sequence[Path], left_out: "LeftOut", names: Sequence[str] | None
) -> list[str]:
    """Return sentences about pictures that the results do not allow; on one rank.

    Raises FolderError if a figure among ``names`` is one of them.
    """
    from vipetsc.figures.registry import OVER_BRANCHES
    from vipetsc.figures.transfer_curves import curves_left_out

    missing = {name: reasons for name, reasons in left_out.reasons.items() if name not in left_out.drawn}
    if asked := [name for name in names or () if name in missing]:
        listed = "; ".join(f"--fig {name}: {next(iter(missing[name].values()))}" for name in asked)
        raise FolderError(f"{folders[0]}: {listed}")
    sentences = _by_reason(pictures, folders, left_out)
    if pictures.kind != SWEEP:
        return sentences

    # Only one page shows branches, and perhaps not all curves of the sweep.
    branches = _folders_of_branches(folders)
    if branches and names and OVER_BRANCHES not in names:
        drawn = ", ".join(names)
        sentences.append(f"{drawn}: without the branches of {', '.join(branches)}; --fig {OVER_BRANCHES} draws both")
    elif branches and OVER_BRANCHES not in missing and (unrelated := curves_left_out(folders)):
        sentences.append(f"{OVER_BRANCHES}: without {unrelated}")
    return sentences


def _by_reason(pictures: Pictures, folders: Sequence[Path], left_out: "LeftOut") -> list[str]:
    """Return a sentence for each reason of ``left_out``; none for figures that few results have."""
    from vipetsc.figures.registry import FIGURES, OVER_BRANCHES

    by_reason: dict[str, list[str]] = {}
    for name, reasons in left_out.reasons.items():
        is_rare = name in FIGURES and FIGURES[name].needs
        # Who draws a sweep together with branches expects the figure that shows both.
        if is_rare and not (name == OVER_BRANCHES and _folders_of_branches(folders)):
            continue
        # Each branch is a result of its own; a measure that one of the sweeps has gives its figure pages.
        for stem, reason in reasons.items():
            if pictures.kind == BRANCHES:
                by_reason.setdefault(reason, []).append(stem)
            elif name not in left_out.drawn and name not in by_reason.setdefault(reason, []):
                by_reason[reason].append(name)
    return [f"no picture of {', '.join(named)}: {reason}" for reason, named in by_reason.items() if named]


def _folders_of_branches(folders: Sequence[Path]) -> list[str]:
    """Return those of ``folders`` drawn with a sweep that hold branches."""
    return [str(folder) for folder in folders if not (folder / "ensemble.h5").exists()]


def newest_result(folders: Sequence[Path]) -> float:
    """Return time, as ``st_mtime``, at which the newest file of results in ``folders`` was written."""
    return max(path.stat().st_mtime for folder in folders for path in folder.glob("*.h5"))
