"""Pictures and movies of a run on a strip of the plane: its motion over the cells (i, j), and over wave vectors."""

from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.strip import StripTable
from vipetsc.figures import panels, style
from vipetsc.figures.movie_frames import WIDTH, CheckedShot, Shot
from vipetsc.figures.page import Page
from vipetsc.figures.style import NoPicture, lay_out
from vipetsc.io.read import field_time
from vipetsc.lattice import UnitCell, bloch, gaps, pass_bands
from vipetsc.lattice.plane import PlaneCell
from vipetsc.spectra.wave_vectors import wave_vector_energies

INSTANTS = 4  # of the snapshots
DECADES = 4  # of energy that a map shows
WIDE = 2.5  # a strip that is so many times as long as wide has its snapshots one below the other
BRANCHES = 181  # points of a branch of the bands
CONTOUR = 181  # points of a wave vector's component along which a line of equal frequency is drawn
INCHES = 8.0  # width of a movie's page for which the sizes of type are chosen


class Strip(NamedTuple):
    """The cell ``plane`` of a strip, its ``cells`` (i,) from 1 that a run recorded, and its ``rows``.

    ``masses`` (i, dof of the wide cell) in kg are those of the recorded cells; ``sites`` (site, 2) and ``drives``
    (drive, 2) are places (i, j) from 1. ``rings`` says whether the ends and whether the edges are joined.
    """

    plane: PlaneCell
    cells: np.ndarray
    rows: int
    masses: np.ndarray
    sites: np.ndarray
    drives: np.ndarray
    rings: tuple[bool, bool]

    @classmethod
    def of(cls, run: xr.Dataset) -> Self:
        """Return the strip of a ``run``; raise NoPicture for another lattice, or a record with gaps."""
        case = Case.of(run)
        section = case.lattice.section_of_strip
        if not section:
            raise NoPicture("needs a strip of the plane ([lattice.strip])")
        cells = run["cell"].values
        if section.rows < 2 or len(cells) < 2 or np.any(np.diff(cells) != 1):
            raise NoPicture("needs a strip of two rows or more, and two contiguous cells or more along it")

        model = case.model()
        plane = section.plane_cell()
        first = int(cells[0]) - 1
        sites = [(site.cell, site.pair.resonator) for site in model.chain.sites]
        drives = [(drive.cell, drive.mass) for drive in model.drives if drive.waveform.amplitude]
        return cls(
            plane=plane,
            cells=cells,
            rows=section.rows,
            masses=model.chain.coefficients(first, first + len(cells)).masses,
            sites=_places(sites, plane.dofs),
            drives=_places(drives, plane.dofs),
            rings=(model.chain.ends == "periodic" and len(cells) == model.chain.cells, section.edges == "periodic"),
        )

    @property
    def ratio(self) -> float:
        """The length of the strip over its width."""
        x, y = self.corners()
        return float((x.max() - x.min()) / (y.max() - y.min()))

    def by_cell(self, field: np.ndarray) -> np.ndarray:
        """Return a ``field`` (..., cell, dof) as one over the plane's cells (..., i, j, dof)."""
        return field.reshape(*field.shape[:-1], self.rows, self.plane.dofs)

    def kinetic(self, velocity: np.ndarray) -> np.ndarray:
        """Return the kinetic energy (..., i, j) in J of the plane's cells at a ``velocity`` (..., cell, dof) in m/s."""
        return np.asarray(self.by_cell(0.5 * self.masses * velocity**2).sum(axis=-1))

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y (i + 1, j + 1) of the corners of the cells."""
        along = np.append(self.cells, self.cells[-1] + 1) - 0.5
        i, j = np.meshgrid(along, np.arange(self.rows + 1) + 0.5, indexing="ij")
        return self._positions(i, j)

    def _positions(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions x and y (...) of places (i, j), in units of the vector along the strip."""
        (x1, y1), (x2, y2) = self.plane.vectors
        return i * x1 + j * x2, i * y1 + j * y2

    def draw(self, axes: Axes, values: np.ndarray, norm: Normalize, cmap: str) -> QuadMesh:
        """Draw a map of ``values`` (i, j), with the contact sites and the drives."""
        mesh = axes.pcolormesh(*self.corners(), values, norm=norm, cmap=cmap, rasterized=True)
        for places, look in ((self.sites, SITES), (self.drives, DRIVES)):
            shown = (places[:, 0] >= self.cells[0]) & (places[:, 0] <= self.cells[-1])
            if shown.any():
                axes.plot(*self._positions(*places[shown].T), **look)
        # The axes count cells; lattices of other vectors than the square's are drawn as they lie.
        axes.set(aspect="equal", xlabel="Cell i" if self.is_square else "Position (distances of cells)")
        axes.set_ylabel("Row j" if self.is_square else "")
        return mesh

    @property
    def is_square(self) -> bool:
        """Whether a position is the number of a cell and a row."""
        return self.plane.vectors == ((1.0, 0.0), (0.0, 1.0))


SITES: dict[str, Any] = {"marker": "s", "ls": "", "ms": 2.2, "mfc": "none", "mec": style.GREEN, "mew": 0.6}
DRIVES: dict[str, Any] = {"marker": "x", "ls": "", "ms": 3.0, "mec": style.GREEN, "mew": 0.8}


def is_strip(run: xr.Dataset) -> bool:
    """Return whether a ``run`` is one of a strip that can be drawn over its cells."""
    try:
        Strip.of(run)
    except NoPicture:
        return False
    return True


def _places(masses: list[tuple[int, int]], dofs: int) -> np.ndarray:
    """Return the places (n, 2), from 1, of masses by their cell and their number in the wide cell, both from 0."""
    return np.array([(cell + 1, mass // dofs + 1) for cell, mass in masses], int).reshape(-1, 2)


def _symmetric(values: np.ndarray) -> Normalize:
    """Return colours from minus to plus the largest magnitude of ``values``."""
    largest = float(np.abs(values).max()) or 1.0
    return Normalize(-largest, largest)


def bands(strip: StripTable, cell: UnitCell, frequency: float | None = None) -> Figure:
    """Draw the bands of a ``strip``, whose wide cell is ``cell``, in colours of the wave number across it.

    Between periodic edges that number tells branches apart: those of k and -k are a full and a dashed line, which
    coincide where the lattice has a mirror. Between other edges colours show the half-waves of most energy.
    """
    plane = strip.plane_cell()
    kappa = np.linspace(0, np.pi, BRANCHES)
    if strip.edges == "periodic":
        waves = 2 * np.pi * np.fft.fftfreq(strip.rows, 1.0)
        frequencies = plane.frequencies(kappa[:, None], waves).reshape(BRANCHES, -1)
        across = np.broadcast_to(np.repeat(waves, plane.dofs), frequencies.shape)
    else:
        point = bloch(cell, kappa)
        frequencies = point.frequency
        across = plane.across(point.vectors * np.sqrt(cell.masses)[:, None], kappa, strip.edges)

    page = Page.of(height=3.0)
    (axes,) = page.panels
    points = np.stack(np.broadcast_arrays(kappa[:, None] / np.pi, frequencies / 1e3), axis=-1)
    segments = np.stack([points[:-1], points[1:]], axis=2)
    colours = across[:-1] / np.pi
    for dashed in (False, True):
        shown = (colours < 0) == dashed
        # A line of many pieces has gaps by leaving out every third of them.
        if dashed:
            shown &= (np.arange(BRANCHES - 1) // 4 % 2 == 0)[:, None]
        lines = LineCollection(segments[shown], array=np.abs(colours[shown]), cmap="viridis", lw=0.7)
        lines.set_clim(0, 1)
        axes.add_collection(lines)
    passing = pass_bands(cell)
    panels.shade_bands(axes, gaps(passing))
    if frequency is not None:
        axes.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    axes.set(xlim=(0, 1), ylim=(0, 1.08 * passing[-1].high / 1e3), xlabel=panels.KAPPA, ylabel=panels.OMEGA)
    axes.set_title(f"{strip.rows} rows, {strip.edges} edges")
    panels.colour_bar(lines, axes, "|Wavenumber across| (π rad/row)", extend="neither")
    return page.lettered()


def snapshots(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw the displacement (m) of the first mass of every cell at four instants."""
    strip = Strip.of(run)
    if "displacement" not in run:
        raise NoPicture("needs the displacements, which were not recorded")
    time = field_time(run)
    rows = np.unique(np.linspace(0, len(time) - 1, INSTANTS + 1).round().astype(int))[1:]
    if not rows.size:
        raise NoPicture("needs two samples or more")
    fields = strip.by_cell(run["displacement"].isel({run["displacement"].dims[0]: rows}).values)[..., 0]

    norm = _symmetric(fields)
    shape = (len(rows), 1) if strip.ratio > WIDE else (-(-len(rows) // 2), 2)
    height = shape[0] * (style.PAGE - 1.2) / shape[1] / strip.ratio
    height = min(height + 0.25 * shape[0] + 0.4, 9.0)
    page = Page.of(*shape, width=style.PAGE, height=height, count=len(rows), sharex=True, sharey=True)
    for axes, field, row in zip(page.panels, fields, rows, strict=True):
        mesh = strip.draw(axes, field, norm, "RdBu_r")
        axes.set_title(f"t = {time[row]:.4g} s")
        axes.label_outer()
    panels.colour_bar(mesh, page.grid, "Displacement (m)", extend="neither", aspect=40)
    if strip.plane.dofs > 1:
        style.add_note(page.figure, f"degree of freedom 1 of the {strip.plane.dofs} of each cell")
    return page.lettered()


def envelope(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw the largest kinetic energy (J) that every cell has at any sample."""
    strip = Strip.of(run)
    if "velocity" not in run:
        raise NoPicture("needs the velocities, which were not recorded")
    largest = np.zeros((len(strip.cells), strip.rows))
    # A sample at a time: fields of a plane may be larger than the memory.
    for row in range(len(field_time(run))):
        largest = np.maximum(largest, strip.kinetic(run["velocity"][row].values))

    page = Page.of(width=style.PAGE, height=(style.PAGE - 1.2) / strip.ratio + 0.7)
    (axes,) = page.panels
    mesh = strip.draw(axes, largest, panels.log_norm(largest, decades=DECADES), "inferno")
    axes.set_title("Largest kinetic energy of a cell at any time")
    panels.colour_bar(mesh, axes, "Energy (J)", cax=panels.bar_axes(axes))
    return page.lettered()


def wave_vectors(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw the energy (J) of the waves at the last sample over wave vectors, with a line at the drive's frequency."""
    strip = Strip.of(run)
    if "velocity" not in run or "displacement" not in run:
        raise NoPicture("needs displacements and velocities")
    content = _content(strip, run, -1)
    if not content.any():
        raise NoPicture("nothing moves at the last sample")

    page = Page.of(height=2.6)
    (axes,) = page.panels
    # From -pi to pi: of an even number of cells -pi is the first wave vector, and the last one, too.
    counts = content.shape
    along, across = (2 * np.arange(-(n // 2), n // 2 + 1) / n for n in counts)
    shown = content[np.ix_(*(np.arange(-(n // 2), n // 2 + 1) % n for n in counts))]
    image = panels.draw_map(axes, along, across, shown.T, panels.log_norm(shown, decades=DECADES), "viridis")
    frequency = Case.of(run).model().drive.frequency
    k = np.linspace(-np.pi, np.pi, CONTOUR)
    branches = strip.plane.frequencies(*np.meshgrid(k, k, indexing="ij"))
    for branch in np.moveaxis(branches, -1, 0):
        if branch.min() < frequency < branch.max():
            axes.contour(k / np.pi, k / np.pi, branch.T, [frequency], colors="white", linewidths=0.5, linestyles="--")
    axes.set(xlim=(-1, 1), ylim=(-1, 1), xlabel="Along the strip (π rad/cell)", ylabel="Across (π rad/cell)")
    axes.set_aspect("equal")
    axes.set_title(f"t = {field_time(run)[-1]:.4g} s")
    panels.colour_bar(image, axes, "Energy per wave vector (J)", cax=panels.bar_axes(axes))
    return page.lettered()


def _content(strip: Strip, run: xr.Dataset, row: int) -> np.ndarray:
    """Return the energies (k1, k2) in J of all branches at a sample; fields that end are tapered towards their ends."""
    fields = [strip.by_cell(run[name][row].values) for name in ("displacement", "velocity")]
    for axis, is_ring in enumerate(strip.rings):
        if not is_ring:
            window = np.expand_dims(spectra.taper(fields[0].shape[axis], spectra.TAPER), tuple({0, 1, 2} - {axis}))
            fields = [field * window for field in fields]
    return np.asarray(wave_vector_energies(strip.plane, *fields).sum(axis=-1))


class StripFrames(NamedTuple):
    """The ``time`` (frame,) in s of a movie, and its ``wave`` (frame, i, j): energy in J or velocity in m/s."""

    time: np.ndarray
    wave: np.ndarray


class StripMovie:
    """The movie of a ``shot`` of a ``run`` on a strip: kinetic energy of the cells, or velocity of their first mass."""

    def __init__(self, run: xr.Dataset, shot: Shot, checked: CheckedShot) -> None:
        run = run.isel(cell=checked.window)
        strip = Strip.of(run)
        time = field_time(run)
        rows = np.rint((checked.time - time[0]) / (time[1] - time[0])).astype(int)
        wave = []
        for row in rows:
            velocity = run["velocity"][row].values
            wave.append(strip.kinetic(velocity) if shot.quantity == "energy" else strip.by_cell(velocity)[..., 0])
        self.content = StripFrames(checked.time, np.array(wave))

        # Both even: an MP4 has one colour for two by two pixels.
        width = (shot.width or WIDTH) // 2 * 2
        inches = (INCHES - 1.2) / strip.ratio + 0.9
        height = round(inches * width / INCHES / 2) * 2
        figure = style.new_figure(INCHES, height * INCHES / width)
        figure.set_dpi(width / INCHES)
        self.figure = figure
        axes = figure.subplots()
        norm: Normalize = _symmetric(self.content.wave)
        cmap = "RdBu_r"
        label = "Velocity (m/s)"
        if shot.quantity == "energy":
            norm = panels.log_norm(self.content.wave, decades=DECADES)
            cmap = "inferno"
            label = "Kinetic energy of a cell (J)"
        self._mesh = strip.draw(axes, self.content.wave[0], norm, cmap)
        panels.colour_bar(self._mesh, axes, label, extend="neither", cax=panels.bar_axes(axes))
        axes.set_title(Case.of(run).name)
        self._time = axes.text(1, 1.02, "", ha="right", va="bottom", transform=axes.transAxes, size=8)
        self._canvas = FigureCanvasAgg(figure)
        lay_out(figure)

    def show(self, k: int) -> None:
        """Let the figure show frame ``k``."""
        self._mesh.set_array(self.content.wave[k])
        self._time.set_text(f"t = {self.content.time[k]:.4f} s")

    def frame(self, k: int) -> np.ndarray:
        """Return frame ``k`` as (row, column, RGBA) bytes, valid until the next one is drawn."""
        self.show(k)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())
