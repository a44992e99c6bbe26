"""Panels that several figures use show their data at their coordinates, with marks, bands, gaps and regions."""

import itertools

import numpy as np
import pytest
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import to_rgba

from vipetsc.figures import panels, style
from vipetsc.figures.nfrc import lag_of
from vipetsc.lattice import bloch, diatomic, four_band, gaps, pass_bands

TIME = np.linspace(0.0, 0.3, 4)
CELLS = np.arange(5, 12)


@pytest.fixture
def axes():
    with style.rc_style():
        yield style.new_figure(3, 2).subplots()


def spans(axes):
    """Return the shaded spans of ``axes``: lower left and upper right corner of each."""
    to_data = axes.transData.inverted()
    return [patch.get_extents().transformed(to_data).get_points() for patch in axes.patches]


def test_a_map_shows_every_value_at_its_coordinates(axes):
    """The brightest pixel of a map lies at the time and cell of the largest value."""
    values = np.full((len(TIME), len(CELLS)), 1e-3)
    values[1, 5] = 2.0
    field = xr.DataArray(values, {"time": TIME, "cell": CELLS}, ("time", "cell"))

    image = panels.space_time_map(axes, field, panels.log_norm(2.0))

    pixels = image.get_array()
    row, column = np.unravel_index(pixels.argmax(), pixels.shape)
    left, right, bottom, top = image.get_extent()
    assert left + (column + 0.5) * (right - left) / len(TIME) == pytest.approx(TIME[1])
    assert bottom + (row + 0.5) * (top - bottom) / len(CELLS) == pytest.approx(CELLS[5])
    assert axes.get_xlabel() == "Time (s)"
    assert axes.get_ylabel() == "Cell"
    # The limits are half a cell beyond the first and the last cell.
    assert axes.get_ylim() == (4.5, 11.5)


@pytest.mark.parametrize(
    ("first", "last", "shown"),
    [
        (0, 4, range(6)),
        (100, 123, range(97, 127)),
        # A twentieth of all cells is enough to be seen among all.
        (100, 149, range(1000)),
        (990, 999, range(989, 1000)),
    ],
)
def test_a_map_of_a_long_lattice_shows_the_cells_that_have_moved(first, last, shown):
    """Of 1000 cells of which few have moved those few are shown, with some at rest on both sides."""
    values = np.full((len(TIME), 1000), 1e-30)
    values[2, first] = 2.0
    values[3, last] = 1.0
    field = xr.DataArray(values, {"time": TIME, "cell": np.arange(1, 1001)}, ("time", "cell"))

    part = panels.moved_cells(field, panels.log_norm(field))

    assert part["cell"].values.tolist() == [cell + 1 for cell in shown]
    assert part.shape[0] == len(TIME)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_value_that_is_not_finite_does_not_blank_a_map(bad, place):
    """Colours are those of the finite values; as before a NaN is drawn as nothing."""
    field = np.array([1e-6, 1e-5, 1e-7])
    field[place] = bad
    assert panels.log_norm(field, [1e-9]).vmax == np.max(field[np.isfinite(field)])


@pytest.mark.parametrize("count", [5, 600, 601, 1000, 1799])
def test_a_map_of_blocks_ends_where_its_field_does(axes, count):
    """Block k of a map with means over blocks lies over its cells, though the last block has fewer."""
    cells = np.arange(1, count + 1)
    image = panels.draw_map(axes, cells, np.arange(3), np.ones((3, count)), panels.log_norm(1.0))
    left, right, _, _ = image.get_extent()
    columns = image.get_array().shape[1]
    assert (right - left) / columns == -(-count // panels.PIXELS)
    assert axes.get_xlim() == (0.5, count + 0.5)


def contrast(text, background) -> float:
    """The contrast of two colours (WCAG 2.1), by the formula for the smaller and the larger luminance."""
    low, high = sorted([panels.luminance(text), panels.luminance(background)])
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("name", ["RdBu_r", "viridis", "inferno"])
def test_numbers_on_a_map_can_be_read(name):
    """Numbers have the contrast of 4.5 that WCAG asks for on every colour of a map, and on the paper of a NaN."""
    colours = colormaps[name](np.linspace(0, 1, 64))
    assert min(contrast(panels.text_colour(colour), colour) for colour in colours) >= 4.5
    assert panels.text_colour((0, 0, 0, 0)) == style.BLACK


@pytest.mark.parametrize("along", ["x", "y"])
def test_sites_are_marked_at_their_cells(axes, along):
    """Each site within the recorded cells has a line and a mark; those in cells 3 and 12 are outside."""
    run = xr.Dataset({"sites/cell": ("site", [3, 6, 11, 12])}, {"cell": CELLS})

    panels.mark_sites(axes, run, along=along)

    data = [line.get_xdata() if along == "x" else line.get_ydata() for line in axes.lines]
    *lines, marks = [list(values) for values in data]
    assert lines == [[6, 6], [11, 11]]
    assert marks == [6, 11]


@pytest.mark.parametrize("cell", [diatomic(), four_band()])
def test_the_dispersion_has_every_branch_over_it(axes, cell):
    """The spectrum's pixels are centred on their wavenumbers and frequencies, and every band of the cell is a line."""
    kappa = np.linspace(0, np.pi, 21)
    omega = np.linspace(0, 4000.0, 31)
    energy = np.outer(np.ones(21), np.arange(31.0))
    spectrum = xr.DataArray(energy, {"wavenumber": kappa, "frequency": omega}, ("wavenumber", "frequency"))

    image = panels.dispersion_map(axes, spectrum, panels.log_norm(30.0), cell)

    np.testing.assert_array_equal(image.get_array(), energy.T)
    # The picture extends by half a bin beyond each end; bins are 1/20 in units of pi and 4/30 krad/s wide.
    assert image.get_extent() == pytest.approx((-0.025, 1.025, -4 / 60, 4 + 4 / 60))
    assert axes.get_xlim() == (0, 1)
    assert axes.get_ylim() == (0, 4)

    assert len(axes.lines) == cell.dofs
    for band, line in enumerate(axes.lines):
        expected = bloch(cell, np.pi * line.get_xdata()).frequency[:, band]
        np.testing.assert_allclose(1e3 * line.get_ydata(), expected)


def test_gaps_are_shaded_and_pass_bands_are_not(axes):
    """A band diagram shades the gaps, draws each band in its colour over its range, and the drive as a line."""
    bands = pass_bands(four_band())

    panels.band_diagram(axes, four_band(), 1000.0)

    shaded = [(low, high) for (_, low), (_, high) in spans(axes)]
    np.testing.assert_allclose(shaded, np.array(gaps(bands)) / 1e3)

    *branches, drive = axes.lines
    colours = (style.BLUE, style.VERMILION, style.GREEN, style.PURPLE)
    assert [to_rgba(line.get_color()) for line in branches] == [to_rgba(colour) for colour in colours]
    assert list(drive.get_ydata()) == [1.0, 1.0]
    for line, band in zip(branches, bands, strict=True):
        assert line.get_ydata().min() == pytest.approx(band.low / 1e3, abs=1e-6)
        assert line.get_ydata().max() == pytest.approx(band.high / 1e3, rel=1e-6)


def test_regions_follow_one_another(axes):
    """Each region is shaded from the end of the one before to its own last point, and is named."""
    energy = np.geomspace(1.0, 1e4, 9)
    region = np.array([1, 1, 2, 2, 3, 3, 3, 4, 4])
    axes.set(xscale="log", xlim=(0.1, 1e4))

    panels.shade_regions(axes, energy, region, 0.5, at_top=True)

    ends = [0.5, *(energy[region == k].max() for k in range(1, 5))]
    shaded = [(low, high) for (low, _), (high, _) in spans(axes)]
    np.testing.assert_allclose(shaded, list(itertools.pairwise(ends)))
    assert [text.get_text() for text in axes.texts] == ["I", "II", "III", "IV"]


def test_means_over_blocks_keep_the_mean():
    """Each of 434 rows is the mean of three of 1300, more than a picture shows; the last one is the remaining row."""
    values = np.random.default_rng(1).random((1300, 7))

    pooled = panels.block_means(values)

    assert pooled.shape == (434, 7)
    np.testing.assert_allclose(pooled[3], values[9:12].mean(axis=0))
    np.testing.assert_allclose(pooled[-1], values[-1])


def test_antiphase_to_the_drive_is_a_lag_of_180_degrees():
    """Without loss the first site is behind the drive by 0 or 180 degrees, whatever the sign of the rounding."""
    harmonics = np.zeros((4, 1, 2))
    harmonics[:, 0, 1] = [-1, -1, 1, -1]
    imaginary = np.zeros((4, 1, 2))
    imaginary[:, 0, 1] = [1e-13, -1e-13, 1e-13, 1e-13]
    names = ("point", "site", "harmonic")

    lag = lag_of(xr.Dataset({"harmonics": (names, harmonics), "harmonics_imaginary": (names, imaginary)}))

    assert lag == pytest.approx(np.array([180, 180, 0, 180]), abs=1e-9)


@pytest.mark.parametrize(("low", "high", "step"), [(-30, 565, 180), (0, 2000, 540), (0, 200, 45)])
def test_ticks_of_a_phase_are_parts_of_a_revolution(axes, low, high, step):
    """Over more than a revolution an axis in degrees has multiples of 180, over half of one multiples of 45."""
    axes.set_ylim(low, high)
    panels.mark_degrees(axes)
    ticks = axes.get_yticks()
    assert 3 <= ((ticks >= low) & (ticks <= high)).sum() <= 6
    assert np.allclose(ticks % step, 0)
