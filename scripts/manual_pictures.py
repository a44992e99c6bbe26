"""Draws the pictures of the built-in run, of two sweeps and of the notebooks again, as small files.

    python scripts/manual_pictures.py [--folder FOLDER]

The built-in run, two sweeps and the notebooks are run in ``FOLDER``, by default a temporary one, which takes two
minutes of CPU time.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image
from small_pictures import save_small

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from mpi4py import MPI

from vipetsc import follow
from vipetsc.case import Case, NnmCase
from vipetsc.figures import schematics, style
from vipetsc.io.read import open_run
from vipetsc.lattice import Contact
from vipetsc.modes.branches.follow import follow_all

PICTURES = ROOT / "vipetsc/manual/pictures"
NOTEBOOKS = ROOT / "vipetsc/manual/notebooks"
# The width of a page's column in pixels. At twice as many the pictures have twice the bytes.
WIDTH = 760
# The most bytes of a picture. The largest one, that of phases, has 48 kB; one that has more was drawn at another size.
MOST = 60_000
# The approach velocity in m/s of the impact that is drawn, half of the largest in the built-in run.
SPEED = 2.0
# Steps of that impact. Their rule is of first order: 4,000 leave an error of 4e-4 of the force, a fifth of a line's
# width in the picture.
STEPS = 4000
# Figures of runs: the name of the picture in the manual, and its file among the results.
DRAWN = {
    "spacetime": "four-band/figures/spacetime.png",
    "impacts": "four-band/figures/impacts.png",
    "ledger": "four-band/figures/ledger.png",
    "modal": "four-band/figures/modal_energies.png",
    "phase": "four-band/figures/phase.png",
    "sweep-curve": "curve/figures/upper_share_at_end-over-drive.amplitude.png",
    "sweep-map": "map/figures/upper_share_at_end-over-drive.amplitude-contacts.restitution.png",
}
CASE = """
[lattice]
preset = "four-band"
cells = 150

[contacts]
sites = [40, 55, 70]

[time]
engine = "propagator"

[sweep]
measures = ["transfer"]

[sweep.drive]
amplitude = { log = [16.0, 200.0], count = 9 }
"""
RESTITUTIONS = "--set=sweep.contacts.restitution=[0.5, 0.6, 0.7, 0.8, 0.9, 1.0]"
COMMANDS = (
    ("run", "--set=time.engine=propagator", "--out=four-band"),
    ("sweep", "case.toml", "--out=curve"),
    ("sweep", "case.toml", RESTITUTIONS, "--out=map"),
)


def impact(contact: Contact, mass: float, clearance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return relative displacement in m and force in N (step,) during an impact of a free pair of masses.

    The pair has the reduced ``mass`` in kg and approaches at ``SPEED``; ``clearance`` is in m.
    """
    dt = 2 * contact.impact_time(SPEED, mass) / STEPS
    x = 0.0
    rate = SPEED
    indentation = [0.0]
    force = [0.0]
    # The loop ends after four times the duration of an elastic impact, STEPS/2 steps: an impact with loss takes longer.
    for _ in range(2 * STEPS):
        pressed = float(contact.elastic_force(x) * contact.dissipation_factor(rate, SPEED))
        # The velocity is updated before the displacement (semi-implicit Euler): the energy of an elastic impact remains
        # bounded.
        rate -= dt * pressed / mass
        x += dt * rate
        if x < 0:
            break
        indentation.append(x)
        force.append(pressed)
    return clearance + np.array(indentation), np.array(force)


def contact_law(case: Case) -> Figure:
    """Draw the force of one impact over the relative displacement, and the effective restitution of damping factors."""
    model = case.model()
    cell = model.chain.cell
    host = cell.masses[cell.host]
    resonator = cell.masses[cell.resonator]
    law = model.chain.sites[-1].law
    clearance = model.chain.sites[-1].clearance

    figure = style.new_figure(style.PAGE, 2.6)
    left, right = figure.subplots(1, 2)
    for restitution, colour in ((1.0, style.BLACK), (0.7, style.BLUE), (0.3, style.VERMILION)):
        contact = Contact("hertz", law.stiffness, restitution)
        w, force = impact(contact, mass=host * resonator / (host + resonator), clearance=clearance)
        left.plot(1e3 * w, force, color=colour, label=f"r = {restitution:g}")
    # Between the stops there is no force.
    left.plot([1.6, 1e3 * clearance], [0, 0], color=style.BLACK, lw=2.0)
    left.axvline(1e3 * clearance, color=style.GREY, lw=0.8, ls="--")
    left.annotate(
        "clearance Δ", (1e3 * clearance, 6), (-4, 0), textcoords="offset points", ha="right", color=style.GREY
    )
    left.set(xlabel="Relative displacement w (mm)", ylabel="Contact force (N)", xlim=(1.6, None), ylim=(-0.5, None))
    left.legend(loc="upper left")
    left.set_title(f"(a) One impact at {SPEED:g} m/s")

    # The curves begin at 0.06, because the factor flores is defined above a restitution of 0.05.
    asked = np.linspace(0.06, 1, 95)
    for factor, colour in (("paper", style.BLUE), ("flores", style.ORANGE), ("exact", style.BLACK)):
        effective = [Contact("hertz", 1.0, r, factor=factor).effective_restitution for r in asked]
        right.plot(asked, effective, color=colour, label=factor)
    right.set(xlabel="Restitution asked for", ylabel="Effective restitution", xlim=(0, 1), ylim=(0, 1))
    right.legend(loc="upper left")
    right.set_title("(b) What an impact returns")
    return figure


def followed() -> Figure:
    """Draw the curves of a pitchfork, with and without an imperfection, and of Bratu's problem."""
    n = 39
    grid = (np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1) - 2 * np.eye(n)) * (n + 1) ** 2
    pitchfork = follow(lambda x, p: p * x - x**3, [0.0], -1.0, 1.0)
    # The imperfect one consists of two curves: each is followed from one of its ends.
    imperfect = [
        *follow(lambda x, p: p * x - x**3 + 1e-2, [0.0], -1.0, 1.0),
        *follow(lambda x, p: p * x - x**3 + 1e-2, [-1.0], 1.0, -1.0),
    ]
    bratu = follow(lambda u, p: grid @ u + p * np.exp(u), np.zeros(n), 0.5, 4.0, largest_step=0.5)

    figure = style.new_figure(style.PAGE, 2.6)
    left, right = figure.subplots(1, 2)
    for axes, curves, colour in ((left, imperfect, style.BLACK), (left, pitchfork, style.BLUE), (right, bratu, "k")):
        for curve in curves:
            x = curve["x"].values[:, curve.sizes["unknown"] // 2]
            p = curve["p"].values
            unstable = curve["unstable"].values > 0
            axes.plot(p, np.where(unstable, np.nan, x), color=colour)
            axes.plot(p, np.where(unstable, x, np.nan), color=colour, ls="--")
            for kind, marker in (("fold", "o"), ("branch-point", "s")):
                chosen = curve["kind"].values == kind
                axes.plot(p[chosen], x[chosen], marker, color=style.VERMILION, ms=4, zorder=5)
    left.set(xlabel="p", ylabel="x", title="(a) Pitchfork")
    right.set(xlabel="p", ylabel="u at 1/2", title="(b) Bratu's problem")
    return figure


def rigid_branches() -> Figure:
    """Draw frequency over energy of a mass between rigid stops, and with one of them, by ``nnm`` and by the formula."""
    own = {
        "masses": [1.0],
        "springs": [{"start": 0, "end": 1, "stiffness": 4.0}],
        "contacts": [{"host": 0, "resonator": 1, "clearance": 1.0}],
    }
    nnm = {"system": "own", "modes": [1], "energy": [0.05, 60.0], "own": own}
    # Beyond the corner: the spring's energy at the stops is 2 J, its frequency 2 rad/s.
    energy = np.geomspace(2.0, 60.0, 400)
    to_stop = np.arcsin(np.sqrt(2.0 / energy)) / 2
    exact = {"both": 4 * to_stop, "plus": 2 * to_stop + np.pi / 2}

    figure = style.new_figure(style.COLUMN, 2.6)
    axes = figure.subplots()
    for side, colour, label in (("both", style.BLUE, "stops on both sides"), ("plus", style.VERMILION, "one stop")):
        case = NnmCase.from_table({"name": "stops", "contacts": {"law": "rigid", "side": side}, "nnm": nnm})
        (branch,) = follow_all(case, None, MPI.COMM_SELF)
        axes.plot(energy, 1 / exact[side], color=style.BLACK, lw=2.5, alpha=0.3, label=None)
        axes.plot(
            [point.energy for point in branch.points],
            [1 / point.period for point in branch.points],
            "o-",
            color=colour,
            lw=0.8,
            ms=2.5,
            label=label,
        )
        corner = next(point for point in branch.points if point.kind == "grazing")
        axes.plot(corner.energy, 1 / corner.period, "s", color=style.BLACK, ms=5, zorder=5)
    axes.plot([], [], color=style.BLACK, lw=2.5, alpha=0.3, label="formula")
    axes.set(xscale="log", xlabel="Energy (J)", ylabel="Frequency (Hz)", xlim=(0.05, 60))
    axes.legend(loc="upper left")
    return figure


def named_cell(run: xr.Dataset) -> Figure:
    """Draw the cell and the lattice of a ``run``, and write the words host, resonator and stop at its boxes."""
    figure = schematics.unit_cell(run, None)
    axes = figure.axes[0]
    by_colour: dict[str, list[Rectangle]] = {style.SKY: [], style.ORANGE: []}
    for patch in axes.patches:
        colour = to_hex(patch.get_facecolor()).upper()
        if isinstance(patch, Rectangle) and colour in by_colour:
            by_colour[colour].append(patch)

    # The widest of the host's boxes is its frame; the others are stops.
    frame, *stops = sorted(by_colour[style.SKY], key=lambda box: -box.get_width())
    (resonator,) = by_colour[style.ORANGE]
    left_stop = min(stops, key=lambda box: (box.get_x(), -box.get_y()))
    top = frame.get_y() + frame.get_height()
    for box, word, shift in ((frame, "host", -1.35), (left_stop, "stop", -0.75), (resonator, "resonator", -0.1)):
        x = box.get_x() + box.get_width() / 2
        y = box.get_y() + 0.8 * box.get_height()
        if box is frame:
            # The line ends at the edge of the host, because the other two boxes are drawn in its middle.
            x = box.get_x() + 0.1
            y = top
        arrow = {"arrowstyle": "-", "color": style.GREY, "lw": 0.6, "shrinkA": 0, "shrinkB": 0}
        place = (frame.get_x() + frame.get_width() / 2 + shift, top + 0.42)
        axes.annotate(word, (x, y), place, arrowprops=arrow, ha="center", fontsize=7, color=style.BLACK, zorder=8)
    return figure


def drawn(folder: Path, draw: Callable[[], Figure]) -> Image.Image:
    """Return the picture of a figure, drawn in the package's style."""
    path = folder / "drawn.png"
    with style.rc_style():
        style.save(draw(), path)
    return Image.open(path)


def draw_notebook(notebook: Path, folder: Path) -> None:
    """Run the cells of a ``notebook`` in ``folder``, and save the picture of each cell that draws one."""
    names: dict[str, object] = {"__name__": "__main__"}
    with contextlib.chdir(folder), mpl.rc_context({"backend": "agg"}), open(os.devnull, "w") as nowhere:
        for number, cell in enumerate(json.loads(notebook.read_text(encoding="utf-8"))["cells"]):
            if cell["cell_type"] != "code":
                continue

            with contextlib.redirect_stdout(nowhere):
                # All cells share one namespace, because they use names of earlier cells.
                exec(compile("".join(cell["source"]), f"{notebook.name}, cell {number}", "exec"), names)
            if plt.get_fignums():
                plt.savefig("cell.png", dpi=style.SCREEN)
                # An open figure would be saved for the next cell too.
                plt.close("all")
                save_small(Image.open("cell.png"), PICTURES / f"notebook-{notebook.stem}-{number}.png", WIDTH, MOST)


def main(arguments: list[str] | None = None) -> int:
    """Make the runs, draw, and write the pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--folder", type=Path, help="for results; a temporary one if left out")
    options = parser.parse_args(arguments)

    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "case.toml").write_text(CASE, encoding="utf-8")
        for verb, *settings in COMMANDS:
            subprocess.run([sys.executable, "-m", "vipetsc", verb, "--quiet", *settings], cwd=folder, check=True)
        for name, path in DRAWN.items():
            save_small(Image.open(folder / path), PICTURES / f"{name}.png", WIDTH, MOST)
        # In the size in which it is drawn: a test compares the README's picture with that of a run.
        dispersion = Image.open(folder / "four-band/figures/dispersion.png").convert("RGB")
        dispersion.save(PICTURES / "four-band.png", optimize=True)
        with open_run(folder / "four-band/run.h5") as run:
            save_small(drawn(folder, lambda: named_cell(run)), PICTURES / "cell.png", WIDTH, MOST)
            save_small(drawn(folder, lambda: contact_law(Case.of(run))), PICTURES / "contact-law.png", WIDTH, MOST)
        save_small(drawn(folder, rigid_branches), PICTURES / "nnm-rigid.png", WIDTH, MOST)
        save_small(drawn(folder, followed), PICTURES / "follow.png", WIDTH, MOST)
        for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
            draw_notebook(notebook, folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
