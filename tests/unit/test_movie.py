"""Movies: contents of frames, data read for them, files that are whole or absent, and input that is refused."""

import numpy as np
import pytest

from tests.unit.test_figures import write_run
from vipetsc.cli.main import main
from vipetsc.figures import movie
from vipetsc.figures.movie_frames import FADE, Shot, movie_frames
from vipetsc.figures.style import rc_style
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_run
from vipetsc.lattice import Chain, bloch, four_band
from vipetsc.spectra import band_envelopes, wave_energies
from vipetsc.studies.reanalysis import measure_run

CELL = four_band()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write a synthetic run, a travelling wave, and analyse it."""
    path = tmp_path_factory.mktemp("run")
    write_run(path / "run.h5")
    measure_run(path)
    return path


@pytest.fixture
def clear(folder):
    """Remove the pictures of the run's folder."""
    for path in (folder / "figures").glob("*"):
        path.unlink()
    return folder


@pytest.fixture(scope="module")
def opened(folder):
    with open_run(folder / "run.h5") as run, open_netcdf(folder / "analysis.h5", "analysis") as analysis:
        yield run, analysis


@pytest.fixture(scope="module")
def stage(opened):
    """Draw the stage of a short, narrow movie: 320 pixels, three frames a second."""
    run, analysis = opened
    shot = Shot(speed=0.016, rate=3.0, width=320)
    with rc_style():
        return movie.MovieFigure(run, movie_frames(run, analysis, shot), shot.width)


def test_envelopes_of_bands_sum_to_the_energy_of_a_ring():
    """Envelopes of all bands sum to the energy of any motion of a ring, the envelope of each to its waves' energy."""
    chain = Chain(CELL, 30, "periodic")
    u, v = 1e-3 * np.random.default_rng(3).standard_normal((2, 30, 4))
    kinetic = 0.5 * (np.square(v) @ CELL.masses).sum()
    potential = 0.5 * u.ravel() @ chain.stiffness_matrix() @ u.ravel()

    envelopes = band_envelopes(CELL, u, v)

    assert envelopes.sum() == pytest.approx(kinetic + potential, rel=1e-12)
    energies, *_ = wave_energies(CELL, u, v)
    assert envelopes.sum(axis=1) == pytest.approx(energies.sum(axis=0), rel=1e-12)


@pytest.mark.parametrize("phase", [0.0, 0.7])
def test_the_envelope_of_a_packet_is_where_the_packet_is(phase):
    """The envelope of a packet is omega^2 |a|^2/2 at the packet, at any phase, and zero in other bands.

    The packet belongs to the third band and has the amplitude a of mass-normalised waves.
    """
    band = 2
    centre = 90
    width = 12
    x = np.arange(200)
    kappa = 1.2
    wave = bloch(CELL, kappa)
    omega = wave.frequency[band]
    profile = np.exp(-(((x - centre) / width) ** 2) + 1j * (kappa * x - phase))
    packet = profile[:, None] * wave.vectors[:, band]
    u = packet.real
    v = (-1j * omega * packet).real

    envelopes = band_envelopes(CELL, u, v)

    energies, *_ = wave_energies(CELL, u, v)
    wavenumbers = 2 * np.pi * np.fft.fftfreq(len(x))
    # Wavenumbers of a ring of 200 cells are 0.031 apart.
    assert wavenumbers[energies[:, band].argmax()] == pytest.approx(kappa, abs=0.04)
    assert envelopes[band].sum() > 0.999 * envelopes.sum()
    assert envelopes[band].argmax() in (centre - 1, centre, centre + 1)
    # Waves of the packet have various velocities, which change its envelope by up to 15 %.
    expected = 0.5 * omega**2 * np.abs(profile) ** 2
    assert envelopes[band, 60:120] == pytest.approx(expected[60:120], rel=0.15)


def test_an_impact_flashes_in_the_frame_whose_time_holds_it_and_fades(opened):
    """A site lights up in the frame that follows its onset, and fades by the factor FADE a frame."""
    # A frame stands for 1.5 ms.
    content = movie_frames(*opened, Shot(start=0.005, stop=0.045, speed=0.015, rate=10.0))

    # The run's six onsets belong to its two sites in turn.
    onsets = np.linspace(0.01, 0.04, 6)
    for site in (0, 1):
        for k in range(1, len(content.time)):
            since = onsets[site::2] > content.time[k - 1]
            struck = np.any(since & (onsets[site::2] <= content.time[k]))
            expected = 1.0 if struck else FADE * content.flash[k - 1, site]
            assert content.flash[k, site] == pytest.approx(expected), (site, k)
    assert (content.flash == 1).sum() == 6
    assert content.sites.tolist() == [8, 16]


def test_an_mp4_is_written_by_ffmpeg_or_not_at_all(clear, stage, tmp_path, monkeypatch):
    """ffmpeg receives every frame; if it fails, its message is raised and the old movie stays."""
    # A script in place of ffmpeg copies its input into the file that its last argument names.
    program = tmp_path / "ffmpeg"
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    program.write_text('#!/bin/sh\nfor last; do :; done\n/bin/cat > "$last"\n')
    program.chmod(0o755)

    (path,) = movie.write_movie(stage, 3.0, [clear / "figures" / "movie.mp4"])

    frames = np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 180, 320, 4)
    assert len(frames) == len(stage.content.time)
    # Drawn as a whole, edges of lines may differ from those of a frame on top of the background.
    assert np.abs(frames[3].astype(int) - stage.frame(3)).mean() < 0.2

    before = path.stat()
    program.write_text('#!/bin/sh\nfor last; do :; done\necho half > "$last"\necho no such codec >&2\nexit 1\n')
    with pytest.raises(OSError, match="no such codec"):
        movie.write_movie(stage, 3.0, [path])
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert [p.name for p in path.parent.iterdir()] == ["movie.mp4"]


def test_without_ffmpeg_there_is_a_gif_and_a_remedy(clear, monkeypatch, capsys):
    """Without ffmpeg a movie is a GIF, and a message says how to install it; a movie requested as MP4 is refused."""
    monkeypatch.setattr(movie, "ffmpeg", lambda: None)
    few = ["plot", str(clear), "--movie", "--speed", "0.016", "--rate", "2", "--width", "320"]
    assert main(few) == 0
    assert [p.name for p in (clear / "figures").iterdir()] == ["movie-energy.gif"]
    message = capsys.readouterr().err
    assert "apt-get install" in message
    assert "imageio-ffmpeg" in message

    assert main([*few, "--format", "mp4"]) == 2
    assert "apt-get install" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "--movie --from 2",
        "--movie --from 0.03 --to 0.02",
        "--movie --to nan",
        "--movie --cells 20:40",
        "--movie --cells 9:9",
        "--movie --cells x",
        "--movie --speed 0",
        "--movie --speed 1e-9",
        "--movie --speed 10",
        "--movie --speed nan",
        "--movie --rate 1000",
        "--movie --width 10",
        "--movie heat",
        "--movie --format png",
        "--movie --fig phase",
        "--speed 2",
        "--format gif",
    ],
)
def test_movies_that_cannot_be_are_refused_and_write_nothing(clear, words, capsys):
    """A range, window, speed or format that gives no movie ends with exit code 2, its option and no file."""
    before = sorted(clear.rglob("*"))
    try:
        code = main(["plot", str(clear), *words.split()])
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    # The last line is the message, after the usage where the value cannot be read. It names the option with the wrong
    # value, or the option that the others need.
    message = capsys.readouterr().err.splitlines()[-1]
    assert words.split()[-2] in message or words.split()[0] in message
    assert sorted(clear.rglob("*")) == before
