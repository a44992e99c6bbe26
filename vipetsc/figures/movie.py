"""Movies of one run: frames over a background that is drawn once, written by Pillow (GIF) or ffmpeg (MP4)."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from PIL import Image

from vipetsc.case import Case
from vipetsc.figures import panels, style
from vipetsc.figures.movie_frames import WIDTH, MovieFrames
from vipetsc.figures.strips import StripFrames
from vipetsc.figures.style import lay_out
from vipetsc.io.atomic import atomic_write
from vipetsc.lattice import UnitCell, bloch

SHAPE = 9 / 16  # height over width, that of screens
INCHES = 8.0  # width of the page for which the sizes of type are chosen
DECADES = 4  # decades of energy that are shown: each then has half an inch of the panel
FAINTEST = 0.05  # opacity of an impact's light below which it is not drawn: it could not be seen
LARGEST = 60.0  # area in square points of the dot of the wave with the most energy
REMEDY = "an MP4 needs ffmpeg: apt-get install --no-install-recommends ffmpeg, or pip install imageio-ffmpeg"


class EnergyCurve(NamedTuple):
    """The ``energy`` (t,) in J over ``time`` (t,) in s of which a line shows more from frame to frame."""

    name: str
    time: np.ndarray
    energy: np.ndarray


class Moving(NamedTuple):
    """An ``artist`` that changes from frame to frame, and the ``axes`` that draw it."""

    axes: Any
    artist: Any


class MovieFigure:
    """The figure of ``content``, ``width`` pixels wide, or one more if that is odd; ``frame`` draws a frame.

    It has three panels: the wave over the cells, with a light at a site for each impact; the dispersion with a dot for
    every wave, larger with more energy; and the energies of the bands over time.
    """

    def __init__(self, run: xr.Dataset, content: MovieFrames, width: int = WIDTH) -> None:
        self.content = content
        # Both even: an MP4 has one colour for two by two pixels.
        width += width % 2
        height = round(width * SHAPE / 2) * 2
        figure = style.new_figure(INCHES, height * INCHES / width)
        figure.set_dpi(width / INCHES)
        self.figure = figure
        ratios = {"width_ratios": (1.6, 1), "height_ratios": (1.4, 1)}
        axes = figure.subplot_mosaic([["wave", "waves"], ["energy", "waves"]], **ratios)

        self._moving: list[Moving] = []
        self._draw_wave(axes["wave"], Case.of(run).name)
        self._draw_waves(axes["waves"], content.cell)
        self._draw_energies(axes["energy"], run)

        # Laid out and drawn once without what moves: a frame is this picture with the moving artists on top.
        self._canvas = FigureCanvasAgg(figure)
        lay_out(figure)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def _add(self, axes: Any, artist: Any) -> Any:
        """Leave ``artist`` out of the background, to draw it in every frame; return it."""
        artist.set_animated(True)
        self._moving.append(Moving(axes, artist))
        return artist

    def _draw_wave(self, axes: Any, name: str) -> None:
        """Draw the panel of the wave over the cells, with sites, impacts and the time."""
        content = self.content
        largest = float(np.abs(content.wave).max()) or 1.0
        # Cells along x, the height of the panel along y.
        across = axes.get_xaxis_transform()
        self._light = self._add(axes, axes.vlines(content.sites, 0, 1, lw=2.5, transform=across))

        nothing = np.full((len(content.cells), content.wave.shape[1]), np.nan)
        lines = axes.plot(content.cells, nothing, lw=1.1)
        self._wave = [self._add(axes, line) for line in lines]
        if content.quantity == "energy":
            for band, line in enumerate(lines, 1):
                line.set_color(style.band_colour(band))
            axes.set(yscale="log", ylim=(largest * 10.0**-DECADES, 2 * largest), ylabel="Energy of a cell (J)")
        else:
            axes.set(ylim=(-1.08 * largest, 1.08 * largest), ylabel="Velocity of the host (m/s)")

        axes.set(xlim=content.cells[[0, -1]] + np.array([-0.5, 0.5]), xlabel="Cell", title=name)
        edge = np.full(len(content.sites), 0.02)
        axes.plot(content.sites, edge, "^", color=style.SKY, ms=4, transform=across)
        self._time = self._add(axes, axes.text(1, 1.02, "", ha="right", va="bottom", transform=axes.transAxes, size=8))

    def _draw_waves(self, axes: Any, cell: UnitCell) -> None:
        """Draw the panel of the dispersion, with a dot for every wave."""
        content = self.content
        self._waves = None
        if not content.wavenumber.size:
            reason = "The waves need displacements and velocities\nof contiguous cells"
            panels.annotate_empty(axes, reason)
            return

        kappa = np.linspace(-np.pi, np.pi, 361)
        axes.plot(kappa / np.pi, bloch(cell, kappa).frequency / 1e3, color=style.GREY, lw=0.5)
        frequency = bloch(cell, content.wavenumber).frequency / 1e3
        band_colours = [to_rgba(style.band_colour(band), 0.7) for band in range(1, cell.dofs + 1)]
        colours = np.tile(band_colours, (len(frequency), 1))
        x = np.repeat(content.wavenumber / np.pi, cell.dofs)
        self._waves = self._add(axes, axes.scatter(x, frequency.ravel(), 0 * x, colours, lw=0))
        axes.axvline(0, color=style.PALE, lw=0.6, zorder=0)
        axes.set(xlim=(-1, 1), ylim=(0, 1.05 * frequency.max()), xticks=(-1, -0.5, 0, 0.5, 1))
        axes.set(title="Energy of the waves", xlabel=panels.KAPPA, ylabel=panels.OMEGA)

    def _draw_energies(self, axes: Any, run: xr.Dataset) -> None:
        """Draw the panel of energies over time, whose lines grow."""
        energies = self.content.energies
        curves = [
            EnergyCurve(name, energies.instants, energy)
            for name, energy in zip(energies.parts, energies.energy, strict=True)
        ]
        curves.append(EnergyCurve("dissipated", run["time"].values, run["energy/dissipated"].values))

        self._growing = []
        for curve in curves:
            look: dict[str, Any] = {"color": style.BLACK, "ls": style.DASHED}
            band = style.band_number(curve.name)
            if band:
                look = {"color": style.band_colour(band), "ls": "-"}
            (line,) = axes.plot([], [], lw=1.2, label=curve.name, **look)
            self._growing.append((self._add(axes, line), curve))

        top = max(float(curve.energy.max()) for curve in curves) or 1.0
        axes.set(xlim=self.content.time[[0, -1]], ylim=(0, 1.08 * top), xlabel="Time (s)", ylabel="Energy (J)")
        axes.legend(loc="lower left", ncols=6, bbox_to_anchor=(0, 1.0))

    def show(self, k: int) -> None:
        """Let the moving artists show frame ``k``."""
        content = self.content
        now = content.time[k]
        for line, values in zip(self._wave, content.wave[k], strict=True):
            line.set_ydata(values)
        lights = [light if light > FAINTEST else 0.0 for light in content.flash[k]]
        self._light.set_color([to_rgba(style.ORANGE, light) for light in lights])
        self._time.set_text(f"t = {now:.4f} s")

        if self._waves is not None:
            # Over the largest of all frames: a dot that shrinks has lost energy.
            relative = content.waves[k].ravel() / (content.waves.max() or 1.0)
            # 1 for the largest energy, 0 for one ``DECADES`` below it, which is not shown.
            level = np.log10(np.maximum(relative, 1e-30)) / DECADES + 1
            self._waves.set_sizes(LARGEST * np.maximum(level, 0.0) ** 2)

        for line, curve in self._growing:
            past = slice(0, int(np.searchsorted(curve.time, now, side="right")))
            # With a point between samples, so that the line ends at the time of the frame.
            energy_now = np.interp(now, curve.time, curve.energy)
            line.set_data(np.append(curve.time[past], now), np.append(curve.energy[past], energy_now))

    def frame(self, k: int) -> np.ndarray:
        """Return frame ``k`` as (row, column, RGBA) bytes, valid until the next one is drawn."""
        self.show(k)
        self._canvas.restore_region(self._background)
        for axes, artist in self._moving:
            axes.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())


def ffmpeg() -> str | None:
    """Return the command of ffmpeg: on the path, or of the package imageio-ffmpeg; None if there is none."""
    command = shutil.which("ffmpeg")
    if command:
        return command
    try:
        return str(import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return None


class Filmed(Protocol):
    """What frames are taken of: a figure that shows and returns frame ``k`` of a ``content`` with their times."""

    figure: Figure

    @property
    def content(self) -> MovieFrames | StripFrames:
        """The content of the frames, of which ``time`` (frame,) is in s."""

    def show(self, k: int) -> None:
        """Let the moving artists show frame ``k``."""

    def frame(self, k: int) -> np.ndarray:
        """Return frame ``k`` as (row, column, RGBA) bytes, valid until the next one is drawn."""


def write_movie(movie: Filmed, rate: float, paths: Sequence[Path]) -> list[Path]:
    """Write the frames of ``movie`` at ``rate`` a second to ``paths``, ``.gif`` and ``.mp4``, each whole or not at all.

    Raises OSError, as when there is no ffmpeg for an MP4.
    """
    for path in paths:
        sys.audit("vipetsc.draw", path.stem)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as aside:
            if path.suffix == ".gif":
                _write_gif(movie, rate, aside)
            else:
                _write_mp4(movie, rate, aside)
    return list(paths)


def _write_gif(movie: Filmed, rate: float, path: Path) -> None:
    """Write a GIF that repeats.

    Pillow takes one frame after the other; matplotlib's PillowWriter keeps all of them in memory, 2 MB each.
    """
    count = len(movie.content.time)
    # The format counts hundredths of a second. The ends of the frames are rounded, not their lengths, so that errors do
    # not add up.
    ends = np.rint(np.arange(count + 1) * 100 / rate)
    durations = [10 * int(length) for length in np.diff(ends)]
    images = (Image.fromarray(movie.frame(k)[..., :3].copy()) for k in range(count))
    first = next(images)
    first.save(path, "GIF", save_all=True, append_images=images, duration=durations, loop=0)


def _write_mp4(movie: Filmed, rate: float, path: Path) -> None:
    """Write an MP4 that browsers play, by matplotlib's writer, which sends the frames to ffmpeg."""
    command = ffmpeg()
    if command is None:
        raise FileNotFoundError(REMEDY)
    # The name of the file does not end with the format's.
    arguments = ["-an", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"]
    writer = FFMpegWriter(fps=rate, extra_args=arguments)
    try:
        with ExitStack() as stack:
            stack.enter_context(mpl.rc_context({"animation.ffmpeg_path": command}))
            stack.enter_context(writer.saving(movie.figure, str(path), movie.figure.dpi))
            for k in range(len(movie.content.time)):
                movie.show(k)
                writer.grab_frame()
    # The writer's last call tells why ffmpeg has ended, perhaps while it was sent a frame.
    except subprocess.CalledProcessError as error:
        reason = str(error.stderr).strip()[-300:]
        raise OSError(f"{command}: {reason}") from None
