"""Movies of one run: frames over a background that is drawn once, written by Pillow (GIF) and ffmpeg (MP4)."""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from PIL import Image

from vipetsc.case import Case
from vipetsc.figures import panels, style
from vipetsc.figures.modal import COLOURS
from vipetsc.figures.movie_frames import WIDTH, Scenes
from vipetsc.io.atomic import atomic_write
from vipetsc.lattice import UnitCell, bloch

SHAPE, INCHES = 9 / 16, 8.0  # height over width; the width that type is set for
DECADES = 4  # of energy that are shown
FAINTEST = 0.05  # light that is shown
LARGEST = 60.0  # area in square points of the dot of the wave with the most energy
STAYS = 255  # the colour of pixels of a GIF that stay as they are
REMEDY = "an MP4 needs ffmpeg: apt-get install --no-install-recommends ffmpeg, or pip install imageio-ffmpeg"


def colour_of(band: int) -> str:
    """The colour of a band, from 0."""
    return COLOURS[band % len(COLOURS)]


class Stage:
    """The figure of ``content``, ``width`` pixels wide; ``frame`` draws what moves."""

    def __init__(self, run: xr.Dataset, content: Scenes, width: int = WIDTH) -> None:
        self.content = content
        figure = style.new_figure(INCHES, round(width * SHAPE / 2) * 2 * INCHES / width)
        figure.set_dpi(width / INCHES)
        ratios = {"width_ratios": (1.6, 1), "height_ratios": (1.4, 1)}
        axes = figure.subplot_mosaic([["wave", "waves"], ["energy", "waves"]], **ratios)
        self._moving: list[tuple[Any, Any]] = []
        self._draw_wave(axes["wave"], Case.of(run).name)
        self._draw_waves(axes["waves"], content.cell)
        self._draw_energies(axes["energy"], run)
        self._canvas = FigureCanvasAgg(figure)
        figure.get_layout_engine().execute(figure)
        figure.set_layout_engine("none")
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def _add(self, axes: Any, artist: Any) -> Any:
        artist.set_animated(True)
        self._moving.append((axes, artist))
        return artist

    def _draw_wave(self, axes: Any, name: str) -> None:
        content, across = self.content, axes.get_xaxis_transform()
        largest = float(np.abs(content.wave).max()) or 1.0
        self._light = self._add(axes, axes.vlines(content.sites, 0, 1, lw=2.5, transform=across))
        lines = axes.plot(content.cells, np.full((len(content.cells), content.wave.shape[1]), np.nan), lw=1.1)
        self._wave = [self._add(axes, line) for line in lines]
        if content.quantity == "energy":
            for band, line in enumerate(lines):
                line.set_color(colour_of(band))
            axes.set(yscale="log", ylim=(largest * 10.0**-DECADES, 2 * largest), ylabel="Energy of a cell (J)")
        else:
            axes.set(ylim=(-1.08 * largest, 1.08 * largest), ylabel="Velocity of the host (m/s)")
        axes.set(xlim=content.cells[[0, -1]] + np.array([-0.5, 0.5]), xlabel="Cell", title=name)
        axes.plot(content.sites, np.full(len(content.sites), 0.02), "^", color=style.SKY, ms=4, transform=across)
        self._time = self._add(axes, axes.text(1, 1.02, "", ha="right", va="bottom", transform=axes.transAxes, size=8))

    def _draw_waves(self, axes: Any, cell: UnitCell) -> None:
        content, kappa, self._waves = self.content, np.linspace(-np.pi, np.pi, 361), None
        if not content.wavenumber.size:
            panels.annotate_empty(axes, "Waves are told apart where displacement and velocity\nof cells side by side"
                                        " were recorded")  # fmt: skip
            return
        axes.plot(kappa / np.pi, bloch(cell, kappa).frequency / 1e3, color=style.GREY, lw=0.5)
        frequency = bloch(cell, content.wavenumber).frequency / 1e3
        colours = np.tile([to_rgba(colour_of(b), 0.7) for b in range(cell.dofs)], (len(frequency), 1))
        x = np.repeat(content.wavenumber / np.pi, cell.dofs)
        self._waves = self._add(axes, axes.scatter(x, frequency.ravel(), 0 * x, colours, lw=0))
        axes.axvline(0, color=style.PALE, lw=0.6, zorder=0)
        axes.set(xlim=(-1, 1), ylim=(0, 1.05 * frequency.max()), xticks=(-1, -0.5, 0, 0.5, 1))
        axes.set(title="Energy of the waves", xlabel=panels.KAPPA, ylabel=panels.OMEGA)

    def _draw_energies(self, axes: Any, run: xr.Dataset) -> None:
        content = self.content
        curves = [(content.instants, *curve) for curve in zip(content.energies, content.parts, strict=True)]
        curves.append((run["time"].values, run["energy/dissipated"].values, "dissipated"))
        self._curves = []
        for t, energy, name in curves:
            band = name.startswith("band")
            colour = colour_of(int(name.split()[1].split("+")[0]) - 1) if band else style.BLACK
            (line,) = axes.plot([], [], color=colour, ls="-" if band else style.DASHED, lw=1.2, label=name)
            self._curves.append((self._add(axes, line), t, energy))
        top = max(float(energy.max()) for _, energy, _ in curves) or 1.0
        axes.set(xlim=content.time[[0, -1]], ylim=(0, 1.08 * top), xlabel="Time (s)", ylabel="Energy (J)")
        axes.legend(loc="lower left", ncols=6, bbox_to_anchor=(0, 1.0))

    def frame(self, k: int) -> np.ndarray:
        """Frame ``k`` as (row, column, RGBA) bytes, valid until the next one is drawn."""
        content, now = self.content, self.content.time[k]
        for line, values in zip(self._wave, content.wave[k], strict=True):
            line.set_ydata(values)
        self._light.set_color([to_rgba(style.ORANGE, light * (light > FAINTEST)) for light in content.flash[k]])
        self._time.set_text(f"t = {now:.4f} s")
        if self._waves is not None:
            level = np.log10(np.maximum(content.waves[k].ravel() / (content.waves.max() or 1.0), 1e-30)) / DECADES + 1
            self._waves.set_sizes(LARGEST * np.maximum(level, 0.0) ** 2)
        for line, t, energy in self._curves:
            past = slice(0, int(np.searchsorted(t, now, side="right")))
            line.set_data(np.append(t[past], now), np.append(energy[past], np.interp(now, t, energy)))
        self._canvas.restore_region(self._background)
        for axes, artist in self._moving:
            axes.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())


def ffmpeg() -> str | None:
    """The command of ffmpeg: on the path, or of the package imageio-ffmpeg; None if there is none."""
    if found_at := shutil.which("ffmpeg"):
        return found_at
    try:
        return str(import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return None


def write_movie(stage: Stage, rate: float, paths: Sequence[Path]) -> list[Path]:
    """Write the frames of ``stage`` at ``rate`` a second to ``paths``, ``.gif`` and ``.mp4``, each whole or not at all.

    Raises OSError, as when there is no ffmpeg for an MP4.
    """
    frames = range(len(stage.content.time))
    for path in paths:
        sys.audit("vipetsc.draw", path.stem)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as aside:
            (_write_gif if path.suffix == ".gif" else _write_mp4)((stage.frame(k) for k in frames), stage, rate, aside)
    return list(paths)


def _write_gif(frames: Iterator[np.ndarray], stage: Stage, rate: float, path: Path) -> None:
    """A GIF that repeats: one palette; pixels that stay are transparent, which makes it several times smaller."""
    count = len(stage.content.time)
    some = np.concatenate([stage.frame(k)[..., :3].copy() for k in np.linspace(0, count - 1, 4).astype(int)])
    palette = Image.fromarray(some).quantize(STAYS, dither=Image.Dither.NONE)
    colours = np.reshape(palette.getpalette(), (-1, 3))
    colours[colours.min(axis=1) > 247] = 255  # Pillow takes the nearest to 252 for white
    palette.putpalette(colours.ravel().tolist())

    def images() -> Iterator[Image.Image]:
        before: Any = -1
        for frame in frames:
            index = np.asarray(Image.fromarray(frame[..., :3]).quantize(palette=palette, dither=Image.Dither.NONE))
            image = Image.fromarray(np.where(index == before, STAYS, index).astype(np.uint8))
            image.putpalette(palette.getpalette())
            before = index
            yield image

    # The format counts hundredths of a second: frames differ by one where that keeps the whole in time.
    lengths = [10 * int(length) for length in np.diff(np.rint(np.arange(count + 1) * 100 / rate))]
    every, form = images(), {"duration": lengths, "loop": 0, "transparency": STAYS, "disposal": 1, "optimize": False}
    next(every).save(path, "GIF", save_all=True, append_images=every, **form)


def _write_mp4(frames: Iterator[np.ndarray], stage: Stage, rate: float, path: Path) -> None:
    command = ffmpeg()
    if command is None:
        raise FileNotFoundError(REMEDY)
    height, width = stage.frame(0).shape[:2]
    raw = ["-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{width}x{height}", "-r", f"{rate:g}", "-i", "-"]
    form = ["-an", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(path)]
    with ExitStack() as stack:
        told = stack.enter_context(tempfile.TemporaryFile())
        call = [command, "-y", "-loglevel", "error", *raw, *form]
        process = stack.enter_context(subprocess.Popen(call, stdin=subprocess.PIPE, stderr=told))
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # what ffmpeg told says why
            for frame in frames:
                process.stdin.write(frame.data)
            process.stdin.close()
        if process.wait():
            told.seek(0)
            raise OSError(f"{command}: {told.read().decode(errors='replace').strip()[-300:]}")
