"""The verb ``plot``: pictures of result folders, drawn again from their files, and movies of runs."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from vipetsc.cli.arguments import Argument, argument
from vipetsc.cli.drawing import Pictures, draw_pictures, prepare
from vipetsc.cli.messages import echo, echo_paths
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.io.atomic import remove_abandoned
from vipetsc.io.folder import FolderError
from vipetsc.io.kinds import RUN
from vipetsc.parallel import StopRequest, on_root

if TYPE_CHECKING:
    from mpi4py import MPI

    from vipetsc.figures.look import Look

NARROWEST = 320  # pixels, at which the type can still be read
WIDEST = 3840  # pixels of the largest screens
FASTEST = 50.0  # frames per second of a GIF, which counts hundredths of a second: viewers slow down shorter frames
MOVIE_FORMATS = "gif", "mp4"
LENGTHS = {"mm": 1 / 25.4, "cm": 1 / 2.54, "in": 1.0, "pt": 1 / 72}  # in inches
PAGE_WIDTHS = 1.0, 40.0  # of a picture, in inches


def positive(text: str) -> float:
    """Return the positive number in ``text``; raises ArgumentTypeError for another one, ValueError for none."""
    value = float(text)
    if not 0 < value < float("inf"):
        # argparse prints the text of this exception; in place of that of a ValueError it prints its own.
        raise argparse.ArgumentTypeError(f"{text} is not positive and finite")
    return value


def window(text: str) -> tuple[int, int]:
    """Return the first and last cell of ``A:B``, from 1; raises ArgumentTypeError for another text."""
    first, separator, last = text.partition(":")
    if not (separator and first.isdigit() and last.isdigit()):
        raise argparse.ArgumentTypeError(f"{text} is not of the form A:B, the first and the last cell, from 1")
    return int(first), int(last)


class Width(NamedTuple):
    """A width, of a movie in ``pixels`` or of a picture in ``inches``; the other one is None."""

    pixels: int | None
    inches: float | None


def width(text: str) -> Width:
    """Return the width in ``text``: pixels without a unit; raises ArgumentTypeError for another text."""
    if text.isdigit():
        return Width(pixels=int(text), inches=None)
    unit = text[-2:]
    narrowest, widest = PAGE_WIDTHS
    try:
        inches = float(text[:-2]) * LENGTHS[unit]
    except (KeyError, ValueError):
        inches = 0.0
    if not narrowest <= inches <= widest:
        raise argparse.ArgumentTypeError(
            f"{text} is neither a width with a unit, such as 86mm (1in to 40in; {', '.join(LENGTHS)}), nor pixels of a"
            " movie"
        )
    return Width(pixels=None, inches=inches)


def label(text: str) -> tuple[str, str]:
    """Return the key and the text of ``KEY=TEXT``; raises ArgumentTypeError for another text."""
    key, separator, value = text.partition("=")
    if not (key and separator):
        raise argparse.ArgumentTypeError(f'{text} is not of the form KEY=TEXT, as in drive.amplitude="Force"')
    return key, value


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
    "width": argument(
        "--width", type=width, metavar="WIDTH", help="width of pictures, as 86mm; of a movie in pixels, by default 960"
    ),
}
# Arguments of pictures alone, by the field of `figures.look.Look` that each of them sets.
LOOK_ARGUMENTS: dict[str, Argument] = {
    "style": argument("--style", metavar="FILE", help="matplotlib style (.mplstyle), on top of the house style"),
    "unit": argument("--unit", choices=("Hz", "rad/s"), default="", help="unit of all frequencies in pictures"),
    "decibels": argument(
        "--db", action="store_true", dest="decibels", help="logarithmic axes of amplitudes and energies in dB"
    ),
    "labels": argument(
        "--label",
        action="append",
        type=label,
        default=[],
        dest="labels",
        metavar="KEY=TEXT",
        help="write TEXT in place of a key or of another text; may be repeated",
    ),
    "titles": argument("--no-title", action="store_false", dest="titles", help="no headings and titles of panels"),
}


def plot(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Draw the pictures of result folders again, or render a movie of a run.

    Raises FolderError where the folders do not have what the options ask for.
    """
    pictures, folders = on_root(comm, lambda: pictures_of(options.path))
    # A folder can be plotted while another command works in it, and is therefore not locked.
    on_root(comm, lambda: remove_abandoned(folders[0] / "figures"))
    formats = set(options.format or ())
    movie_options = {name: getattr(options, name) for name in MOVIE_ARGUMENTS if getattr(options, name) is not None}
    size = movie_options.pop("width", Width(None, None))
    if size.pixels is not None:
        movie_options["width"] = size.pixels

    if options.movie:
        unsuitable = sorted(formats - {*MOVIE_FORMATS})
        if options.fig:
            unsuitable.append("--fig")
        if size.inches is not None:
            unsuitable.append("a width in mm, cm, in or pt; give pixels")
        if unsuitable:
            raise FolderError(f"--movie: writes a GIF or MP4 file and cannot be combined with {unsuitable[0]}")
        # On rank 0 alone: all frames go into one file, in their order.
        paths, missing = on_root(comm, lambda: film(pictures, folders[0], options.movie, movie_options, formats))
        echo_paths(comm, paths)
        if missing:
            echo(comm, f"vipetsc: {missing}", sys.stderr)
        return DONE

    if size.pixels is not None:
        raise FolderError("--width: pixels are for movies (--movie); give a picture's width a unit, as in 86mm")
    misplaced = [MOVIE_ARGUMENTS[name].flag for name in movie_options]
    misplaced += [f"--format {name}" for name in MOVIE_FORMATS if name in formats]
    if misplaced:
        raise FolderError(f"{misplaced[0]}: applies only to movies; add --movie")
    if options.record and pictures.kind != RUN:
        raise FolderError("--record: applies only to pictures of runs, as --fig points")
    names = options.fig or (["points"] if options.record else None)
    formats_asked = tuple(options.format or ("png",))
    look = on_root(comm, lambda: look_of(options, size.inches))
    drawn = draw_pictures(pictures, folders, comm, names, formats_asked, look=look, records=options.record)
    echo_paths(comm, drawn)
    return DONE


def look_of(options: argparse.Namespace, inches: float | None) -> "Look":
    """Return the look of pictures that the options ask for, with a width in ``inches`` or that of each figure.

    Called on one rank. Raises FolderError for a style that is not one.
    """
    from vipetsc.figures.look import Look, style_problem

    if options.style and (problem := style_problem(options.style)):
        raise FolderError(f"--style {options.style}: {problem}")
    return Look(
        style=options.style,
        width=inches,
        unit=options.unit,
        decibels=options.decibels,
        labels=dict(options.labels),
        titles=options.titles,
    )


def pictures_of(paths: Sequence[Path]) -> tuple[Pictures, list[Path]]:
    """Return the pictures of the results in ``paths``, which may be files, and their folders; on one rank.

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

    if missing := [str(path) for path in paths if not path.exists()]:
        raise FolderError(f"{', '.join(missing)}: no such folder")
    if len(folders) > 1:
        for folder in folders:
            if not any(pictures.are_of([folder]) for pictures in by_source.values()):
                raise FolderError(f"{folder}: contains no finished results")
        raise FolderError(
            f"{' '.join(map(str, paths))}: only runs, or sweeps and folders of branches, can be drawn on one page"
        )
    return by_source["run"], folders


def film(
    pictures: Pictures, folder: Path, quantity: str, options: dict[str, Any], formats: set[str]
) -> tuple[list[Path], str]:
    """Render a movie of a ``quantity`` of the run in ``folder``; on one rank.

    ``options`` are arguments of `Shot` by name, ``formats`` the names in `MOVIE_FORMATS` to write, none for all that
    can be written. Returns the files, and a sentence about a format that was left out, empty if none was. Raises
    FolderError, before anything is written, if ``folder`` holds no run or the options do not fit it.
    """
    from vipetsc.figures import movie, movie_frames, strips
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
            checked = movie_frames.check(run, shot)
        except ValueError as error:
            raise FolderError(f"{folder}: {error}") from None

        # Only after all options were checked: measuring writes a file, and bad input must write none.
        prepare(pictures, [folder])
        analysis = stack.enter_context(open_netcdf(folder / "analysis.h5", "analysis"))
        paths = [folder / "figures" / f"movie-{quantity}.{name}" for name in MOVIE_FORMATS if name in formats]
        if strips.is_strip(run):
            return movie.write_movie(strips.StripMovie(run, shot, checked), shot.rate, paths), missing
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
            help="folder of results, or the file in it, such as run.h5 or law.h5; several folders may hold runs, or"
            " sweeps and branches, which then share pages",
        ),
        argument("--fig", action="append", metavar="NAME", help="draw only this figure; may be repeated"),
        argument(
            "--format",
            action="append",
            choices=("png", "pdf", "svg", "gif", "mp4"),
            help="default: png; for movies gif and, if ffmpeg is installed, mp4; may be repeated",
        ),
        argument(
            "--movie",
            nargs="?",
            choices=("energy", "velocity"),
            const="energy",
            help="make a movie of a run: energy of the bands by cell, or velocity of the host masses",
        ),
        argument(
            "--record",
            action="append",
            default=[],
            metavar="FILE[:COLUMN=POINT]",
            help="draw a measured record over the points of a run; may be repeated",
        ),
        *LOOK_ARGUMENTS.values(),
        *MOVIE_ARGUMENTS.values(),
    ),
    function=plot,
)
