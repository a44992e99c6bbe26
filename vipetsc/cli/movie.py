"""The verb plot: pictures of what folders hold again, from their files, and movies of runs."""

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.cli.messages import echo
from vipetsc.cli.plot import draw_source, prepare, source_of
from vipetsc.cli.verbs import DONE, echo_paths
from vipetsc.io.folder import FolderError
from vipetsc.parallel import StopRequest, on_root

WIDTHS, FASTEST = (320, 3840), 50.0  # pixels, frames a second that a GIF can have
OF_MOVIES = {"speed": "--speed", "start": "--from", "stop": "--to", "cells": "--cells", "rate": "--rate",
             "width": "--width"}  # fmt: skip


def positive(text: str) -> float:
    """A positive, finite number."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not positive and finite")
    return value


def window(text: str) -> tuple[int, int]:
    """First and last of ``A:B``."""
    first, separator, last = text.partition(":")
    if not (separator and first.isdigit() and last.isdigit()):
        raise argparse.ArgumentTypeError(f"{text} is not A:B, the first and the last cell, from 1")
    return int(first), int(last)


def plot(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Pictures of what folders hold again, from their files, or a movie of a run."""
    source, folders = on_root(comm, lambda: source_of(options.path))
    given = {name: value for name in OF_MOVIES if (value := getattr(options, name)) is not None}
    formats = set(options.format or ())
    if options.movie:
        if wrong := formats - {"gif", "mp4"} or (options.fig and {"--fig"}):
            raise FolderError(f"--movie: is a gif or an mp4 of its own, without {min(wrong)}")
        paths, missing = on_root(comm, lambda: _film(source, folders[0], options.movie, given, formats))
        echo_paths(comm, paths)
        if missing:
            echo(comm, f"vipetsc: {missing}", sys.stderr)
        return DONE
    if wrong := [OF_MOVIES[name] for name in given] + [f"--format {name}" for name in sorted(formats & {"gif", "mp4"})]:
        raise FolderError(f"{wrong[0]}: is of a movie; add --movie")
    echo_paths(comm, draw_source(source, folders, comm, options.fig, tuple(options.format or ("png",))))
    return DONE


def _film(source: str, folder: Path, quantity: str, given: dict[str, Any], formats: set[str]) -> tuple[list[Path], str]:
    """The files of a movie, and what is to be told of the ones that could not be; nothing is written on bad input."""
    from vipetsc.figures import movie, movie_frames
    from vipetsc.figures.style import rc_style
    from vipetsc.io.netcdf import open_netcdf
    from vipetsc.io.read import open_run

    if source != "run":
        raise FolderError(f"--movie: {folder} holds no run; of a sweep: run CASE --member ID, then plot that")
    if not (folder / "run.h5").exists():
        raise FolderError(f"{folder}: holds no run.h5; a finished run's folder is needed")
    shot = movie_frames.Shot(quantity, **given)
    if shot.rate > FASTEST or not WIDTHS[0] <= shot.width <= WIDTHS[1]:
        raise FolderError(f"--rate {shot.rate:g} --width {shot.width}: at most {FASTEST:g} a second,"
                          f" {WIDTHS[0]} to {WIDTHS[1]} pixels")  # fmt: skip
    has_ffmpeg = movie.ffmpeg() is not None
    if "mp4" in formats and not has_ffmpeg:
        raise FolderError(f"--format mp4: {movie.REMEDY}")
    wanted = [name for name in ("gif", "mp4") if name in (formats or {"gif", *["mp4"] * has_ffmpeg})]
    with rc_style(), ExitStack() as stack:
        run = stack.enter_context(open_run(folder / "run.h5"))
        try:
            movie_frames.check(run, shot)
        except ValueError as error:
            raise FolderError(f"{folder}: {error}") from None
        prepare("run", [folder], None)
        analysis = stack.enter_context(open_netcdf(folder / "analysis.h5", "analysis"))
        stage = movie.Stage(run, movie_frames.scenes(run, analysis, shot), shot.width)
        paths = [folder / "figures" / f"movie-{quantity}.{suffix}" for suffix in wanted]
        return movie.write_movie(stage, shot.rate, paths), "" if has_ffmpeg or formats else f"no MP4: {movie.REMEDY}"
