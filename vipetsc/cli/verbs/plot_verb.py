"""The verb ``plot``: pictures of result folders, drawn again from their files, and movies of runs."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.cli.arguments import Argument, argument
from vipetsc.cli.drawing import Pictures, draw_pictures, prepare
from vipetsc.cli.messages import echo, echo_paths
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.io.atomic import remove_abandoned
from vipetsc.io.folder import FolderError
from vipetsc.io.kinds import RUN
from vipetsc.parallel import StopRequest, on_root

NARROWEST = 320  # pixels, at which the type can still be read
WIDEST = 3840  # pixels of the largest screens
FASTEST = 50.0  # frames per second of a GIF, which counts hundredths of a second: viewers slow down shorter frames
MOVIE_FORMATS = "gif", "mp4"


def positive(text: str) -> float:
    """The positive number in ``text``; raises ArgumentTypeError for one that is not positive, ValueError for none."""
    value = float(text)
    if not 0 < value < float("inf"):
        # argparse prints the text of this exception; in place of that of a ValueError it prints its own.
        raise argparse.ArgumentTypeError(f"{text} is not positive and finite")
    return value


def window(text: str) -> tuple[int, int]:
    """First and last cell of ``A:B``, from 1; raises ArgumentTypeError for another text."""
    first, separator, last = text.partition(":")
    if not (separator and first.isdigit() and last.isdigit()):
        raise argparse.ArgumentTypeError(f"{text} is not of the form A:B, the first and the last cell, from 1")
    return int(first), int(last)


# Arguments of movies, by the field of `figures.movie_frames.Shot` that each of them sets.
MOVIE_ARGUMENTS: dict[str, Argument] = {
    "speed": argument(
        "--speed",
        type=positive,
        metavar="X",
        help="movie: simulated seconds per second; by default the movie lasts 10 s",
    ),
    "start": argument("--from", type=float, metavar="T", dest="start", help="movie: first time in s"),
    "stop": argument("--to", type=float, metavar="T", dest="stop", help="movie: last time in s"),
    "cells": argument("--cells", type=window, metavar="A:B", help="movie: first and last cell"),
    "rate": argument("--rate", type=positive, metavar="N", help="movie: frames per second; default: 15"),
    "width": argument("--width", type=int, metavar="PIXELS", help="movie: width in pixels; default: 960"),
}


def plot(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Draw the pictures of result folders again, or render a movie of a run.

    Raises FolderError where the folders do not have what the options ask for.
    """
    pictures, folders = on_root(comm, lambda: pictures_of(options.path))
    # A folder can be plotted while another command works in it, and is therefore not locked.
    on_root(comm, lambda: remove_abandoned(folders[0] / "figures"))
    formats = set(options.format or ())
    movie_options = {name: getattr(options, name) for name in MOVIE_ARGUMENTS if getattr(options, name) is not None}

    if options.movie:
        unsuitable = sorted(formats - {*MOVIE_FORMATS})
        if options.fig:
            unsuitable.append("--fig")
        if unsuitable:
            raise FolderError(f"--movie: writes a GIF or MP4 file and cannot be combined with {unsuitable[0]}")
        # On rank 0 alone: all frames go into one file, in their order.
        paths, missing = on_root(comm, lambda: film(pictures, folders[0], options.movie, movie_options, formats))
        echo_paths(comm, paths)
        if missing:
            echo(comm, f"vipetsc: {missing}", sys.stderr)
        return DONE

    misplaced = [MOVIE_ARGUMENTS[name].flag for name in movie_options]
    misplaced += [f"--format {name}" for name in MOVIE_FORMATS if name in formats]
    if misplaced:
        raise FolderError(f"{misplaced[0]}: applies only to movies; add --movie")
    drawn = draw_pictures(pictures, folders, comm, options.fig, formats=tuple(options.format or ("png",)))
    echo_paths(comm, drawn)
    return DONE


def pictures_of(paths: Sequence[Path]) -> tuple[Pictures, list[Path]]:
    """The pictures of the results in ``paths``, and their folders, also where files of results are named; on one rank.

    A folder in which no results are recognised counts as that of a run, whose pictures say what is missing. Raises
    FolderError for folders whose results cannot share a page.
    """
    from vipetsc.cli.verbs.verb_list import study_verbs

    # Pictures are listed by their source, since verbs that leave the same kind of folder have them in common.
    by_source = {verb.pictures.kind.source: verb.pictures for verb in study_verbs() if verb.pictures}
    files = {pictures.kind.file for pictures in by_source.values()}
    folders = list(paths)
    for i, path in enumerate(paths):
        if any(path.match(pattern) for pattern in files):
            folders[i] = path.parent
        # Pages name branches of one name by their folders, and "." has no name.
        if not folders[i].name:
            folders[i] = folders[i].absolute()
    for pictures in by_source.values():
        if pictures.are_of(folders):
            return pictures, folders

    if len(folders) > 1:
        raise FolderError(f"{' '.join(map(str, paths))}: only sweeps and folders of branches can be drawn on one page")
    return by_source["run"], folders


def film(
    pictures: Pictures, folder: Path, quantity: str, options: dict[str, Any], formats: set[str]
) -> tuple[list[Path], str]:
    """Render a movie of a ``quantity`` of the run in ``folder``; on one rank.

    ``options`` are arguments of `Shot` by name, ``formats`` the names in `MOVIE_FORMATS` to write, none for all that
    can be written. Returns the files, and a sentence about a format that was left out, empty if none was. Raises
    FolderError, before anything is written, if ``folder`` holds no run or the options do not fit it.
    """
    from vipetsc.figures import movie, movie_frames
    from vipetsc.figures.style import rc_style
    from vipetsc.io.netcdf import naming_spoilt, open_netcdf
    from vipetsc.io.read import open_run

    if pictures.kind != RUN:
        raise FolderError(
            f"--movie: {folder} contains no run; for a sweep, repeat a member with run CASE --member ID and plot"
            f" that run"
        )
    if not (folder / "run.h5").exists():
        raise FolderError(f"{folder}: contains no run.h5; give the folder of a finished run")
    shot = movie_frames.Shot(quantity, **options)
    if shot.rate > FASTEST or not NARROWEST <= shot.width <= WIDEST:
        raise FolderError(
            f"--rate {shot.rate:g} --width {shot.width}: at most {FASTEST:g} frames/s, {NARROWEST} to {WIDEST} pixels"
        )

    # A format asked for by name is refused where it cannot be written; a default one is left out, with a message.
    has_ffmpeg = movie.ffmpeg() is not None
    missing = ""
    if "mp4" in formats and not has_ffmpeg:
        raise FolderError(f"--format mp4: {movie.REMEDY}")
    if not formats:
        formats = {*MOVIE_FORMATS}
        if not has_ffmpeg:
            formats = {"gif"}
            missing = f"no MP4: {movie.REMEDY}"

    with rc_style(), ExitStack() as stack:
        run = stack.enter_context(open_run(folder / "run.h5"))
        try:
            movie_frames.check(run, shot)
        except ValueError as error:
            raise FolderError(f"{folder}: {error}") from None

        # Only after all options were checked: measuring writes a file, and bad input must write none.
        prepare(pictures, [folder])
        analysis = stack.enter_context(open_netcdf(folder / "analysis.h5", "analysis"))
        paths = [folder / "figures" / f"movie-{quantity}.{name}" for name in MOVIE_FORMATS if name in formats]
        with naming_spoilt(lambda: [run, analysis]):
            stage = movie.MovieFigure(run, movie_frames.movie_frames(run, analysis, shot), shot.width)
            return movie.write_movie(stage, shot.rate, paths), missing


VERB = PlainVerb(
    name="plot",
    text="draw pictures again from result files; make movies",
    example="plot runs/four-band --fig dispersion --format pdf",
    arguments=(
        argument(
            "path",
            type=Path,
            nargs="+",
            metavar="PATH",
            help="folder of results, or the file in it, such as run.h5 or law.h5; several folders may hold sweeps and"
            " branches, which then share pages",
        ),
        argument("--fig", action="append", metavar="NAME", help="draw only this figure; may be repeated"),
        argument(
            "--format",
            action="append",
            choices=("png", "pdf", "gif", "mp4"),
            help="default: png; for movies gif and, if ffmpeg is installed, mp4; may be repeated",
        ),
        argument(
            "--movie",
            nargs="?",
            choices=("energy", "velocity"),
            const="energy",
            help="make a movie of a run: energy of the bands by cell, or velocity of the host masses",
        ),
        *MOVIE_ARGUMENTS.values(),
    ),
    function=plot,
)
