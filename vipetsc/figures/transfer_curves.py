"""Inter-band transfer over the amplitude (paper, Fig. 9), beside a branch (Figs. 12, S7, S8), and its regimes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from string import ascii_lowercase
from typing import Any, NamedTuple, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case, Sweep
from vipetsc.figures import style
from vipetsc.figures.panels import band_of, note, recorded_sites, shade_regions
from vipetsc.figures.runs import centre_axes, refined
from vipetsc.figures.sweep_members import (
    AMPLITUDE,
    Files,
    Labels,
    MeasuredRun,
    Sweeps,
    grouped,
    sites_of,
    transfer_members,
)
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import curves, field_interval, field_time
from vipetsc.spectra import doubt

MARKERS = "os^Dv"  # of configurations
FEWEST = 6  # amplitudes that make a curve
PERIODS = 10  # of the drive that a phase portrait shows


class Curve(NamedTuple):
    """What was measured of one law, reading and configuration, by name; ``case`` stands for its members."""

    case: Case
    data: Mapping[Any, Any]


def transfer_curves(sweeps: Sweeps) -> Iterator[Curve]:
    """The curves over rising amplitude of all sweeps with at least ``FEWEST`` amplitudes whose transfer is known.

    ``peak`` is the index of the largest "ibtet", ``floor`` the transfer without any contact, NaN if all members touch.
    """
    for ensemble in sweeps:
        sweep = Sweep.of(ensemble)
        for row, number in curves(ensemble, AMPLITUDE) if "ibtet" in ensemble else ():
            case, data = sweep.case(number), row.sortby(AMPLITUDE)
            transfer = data["ibtet"].values
            if sites_of(case) and np.isfinite(transfer).sum() >= FEWEST:
                untouched = transfer[data["contact_episodes"].values == 0]
                floor = untouched.mean() if untouched.size else np.nan
                yield Curve(case, data.assign(floor=floor, peak=int(np.nanargmax(transfer))))


def columns_of_laws(shown: Sequence[Curve], ylabel: str, panel: Callable[[Axes, Curve], str]) -> Figure:
    """A page of one configuration: a column a law, drawn by ``panel``, which returns the column's title."""
    shown = sorted(shown, key=lambda curve: curve.case.contacts.law, reverse=True)
    figure = style.new_figure(style.PAGE if len(shown) > 1 else 4.3, 2.9, Labels.of(shown[0].case).page)
    grid = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for tag, axes, curve in zip(ascii_lowercase, grid, shown, strict=False):
        axes.set_title(f"({tag}) {panel(axes, curve)}")
    grid[0].set_ylabel(ylabel)
    return figure


def sampled_points(sweeps: Sweeps) -> Iterator[Curve]:
    """The configurations that were sampled at single amplitudes."""
    for ensemble in sweeps:
        if "statistics/ibtet/mean" in ensemble and AMPLITUDE not in ensemble.sizes:
            for index in np.ndindex(*ensemble["number"].shape):
                point = ensemble.isel(dict(zip(ensemble["number"].dims, index, strict=True)))
                yield Curve(Sweep.of(ensemble).case(int(point["number"])), point)


def ibtet(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """One page a reading, a column a law: about the peaks on linear scales, all amplitudes in logarithms."""
    points = list(sampled_points(sweeps))
    for reading, of_reading in grouped(transfer_curves(sweeps), lambda curve: curve.case.lattice.reading).items():
        yield style.Drawing(
            reading, partial(_page, reading, of_reading, [p for p in points if p.case.lattice.reading == reading])
        )


def _page(reading: str, of_reading: Sequence[Curve], points: Sequence[Curve]) -> Figure:
    laws = sorted({c.case.contacts.law for c in of_reading}, reverse=True)
    kinds = list(dict.fromkeys(Labels.of(c.case).configuration for c in of_reading))
    figure = style.new_figure(style.PAGE if len(laws) > 1 else style.COLUMN, 4.6)
    grid = figure.subplots(2, len(laws), sharey="row", squeeze=False)
    figure.supxlabel("Amplitude of the drive (N)")
    figure.supylabel("Inter-band transfer (1)")
    for tag, (linear, logarithmic), law in zip(ascii_lowercase, grid.T, laws, strict=False):
        of_law = [c for c in of_reading if c.case.contacts.law == law]
        for line, curve in enumerate(of_law):
            number = kinds.index(Labels.of(curve.case).configuration)
            amplitudes, transfer = (np.asarray(curve.data[name]) for name in (AMPLITUDE, "ibtet"))
            line_style = {"color": f"C{number}", "marker": MARKERS[number % len(MARKERS)], "ms": 2.2, "lw": 0.7}
            for axes in (linear, logarithmic):
                axes.plot(amplitudes, transfer, label=kinds[number], **line_style)
                if band := band_of(curve.data, "ibtet"):
                    label = "" if line else "5 to 95 % of samples"
                    axes.fill_between(amplitudes, *band, color=f"C{number}", alpha=0.25, lw=0, label=label)
                if np.isfinite(curve.data["floor"]):
                    axes.axhline(float(curve.data["floor"]), color=f"C{number}", lw=0.6, ls=style.DASHED, zorder=1)
            for case, point in points:
                if case.contacts.law == law and Labels.of(case).configuration == kinds[number]:
                    mean, deviation = (point[f"statistics/ibtet/{name}"].item() for name in ("mean", "deviation"))
                    bar = {"color": f"C{number}", "mec": style.BLACK, "mew": 0.4, "ms": 3.5, "capsize": 2, "zorder": 5}
                    linear.errorbar(
                        case.drive.amplitude, mean, deviation, fmt="D", label="mean ± std of samples", **bar
                    )
                    linear.legend(handles=linear.containers[:1], loc="center right")
            # A ring round the largest value of each, and what it is.
            amplitude, largest = amplitudes[curve.data["peak"]], transfer[curve.data["peak"]]
            linear.plot(amplitude, largest, "o", mfc="none", mec=f"C{number}", ms=6, mew=0.7)
            linear.text(0.97, 0.94 - 0.09 * line, f"largest: {largest:.3f} at {amplitude:.3g} N", ha="right", va="top",
                        color=f"C{number}", transform=linear.transAxes)  # fmt: skip
        reach = max(6 * c.data[AMPLITUDE][c.data["peak"]] for c in of_law)
        linear.set(title=f"({tag}.1) {law.capitalize()}, {reading}", xlim=(0, float(reach)))
        logarithmic.set(title=f"({tag}.2) {law.capitalize()}, {reading}", xscale="log", yscale="log")
        logarithmic.legend(loc="upper right")
    for row, low, high in ((grid[0], 0, None), (grid[1], None, 6.0)):  # the limits of all columns, once all is drawn
        row[0].set_ylim(low, high)
    return figure


def ibtet_backbone(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Every reading and configuration of ``backbone.h5``, laws in columns; one made of another sweep is passed over."""
    for ensemble in sweeps:
        path = Path(ensemble.attrs["folder"]) / "backbone.h5"
        if not path.exists():
            continue
        with open_netcdf(path, "backbone", ("case",)) as file:
            values = {**file.attrs, **{name: variable.values for name, variable in file.variables.items()}}
        if values["case"] != ensemble.attrs["case"]:
            continue
        names = grouped((str(name) for name in values if "/" in str(name)), lambda name: name.partition("/")[0])
        tables = ({name.partition("/")[2]: values[name] for name in of_group} for of_group in names.values())
        aligned = [Curve(Case.from_toml(table["case"]), table) for table in tables]
        for name, columns in grouped(aligned, lambda curve: Labels.of(curve.case).page_stem).items():
            yield style.Drawing(
                name, partial(columns_of_laws, columns, "Inter-band transfer, normalised slope (1)", _superposition)
            )


def _superposition(axes: Axes, aligned: Curve) -> str:
    """Points of the lattice, red where fitted; slope over the divisor dashed, with the floor grey; the law green."""
    curve = aligned.data
    energy, transfer, fitted = curve["energy"], curve["ibtet"], curve["fitted"].astype(bool)
    branch, slope, region = (curve[f"branch/{name}"] for name in ("energy", "slope", "region"))
    grazing, floor = curve["grazing_energy"], curve["floor"]
    scaled = np.where(region == 1, 0.0, np.abs(slope)) / curve["divisor"]
    left, right = 0.5 * min(energy.min(), 0.1 * grazing), 2 * energy.max()
    # Region I goes on to the left: below the first point of the branch its slope is zero as well.
    with_floor = np.append(left, branch), floor + np.append(0.0, scaled)
    axes.plot(*with_floor, color=style.GREY, lw=2.2, alpha=0.55, label="slope + floor")
    label = f"slope, $E^{{{curve['slope_exponent']:.2f}}}$ there"
    axes.plot(branch, np.where(scaled > 0, scaled, np.nan), color=style.BLACK, lw=0.8, ls=style.DASHED, label=label)
    axes.plot(energy, transfer, "-o", color=style.BLUE, ms=2.6, mfc="white", mew=0.6, lw=0.6, label="lattice")
    axes.plot(energy[fitted], transfer[fitted], "o", color=style.RED, ms=2.8, label="in region III")
    label = f"$E^{{{curve['exponent']:.2f}}}$, adj. $R^2$ {curve['r2_adjusted']:.3f}"
    law = curve["factor"] * energy[fitted] ** curve["exponent"]
    if doubts := doubt(fitted.sum(), curve["r2_adjusted"]):
        law, label = np.full_like(law, np.nan), f"no power law: {doubts}"
    axes.plot(energy[fitted], law, color=style.GREEN, lw=1.4, zorder=4, label=label)
    shade_regions(axes, np.minimum(np.where(region == 1, grazing, branch), right), region, left, at_top=False)
    axes.set(xscale="log", yscale="log", xlabel="Normalised energy (J)", xlim=(left, right), ylim=(0.25 * floor, 4.0))
    axes.legend(loc="upper right", fontsize=6)
    return f"{Labels.of(aligned.case).law}; branch of the {curve['branch_reading']} reading"


class ContactMotion(NamedTuple):
    """Displacement in m and velocity in m/s (t, 2) of host and resonator of the contact cell, and the transfer."""

    case: Case
    displacement: np.ndarray
    velocity: np.ndarray
    ibtet: float

    @classmethod
    def of(cls, member: MeasuredRun) -> Self:
        """The ``member`` for ``PERIODS`` of the drive about its largest relative displacement."""
        run, cell = member.run, member.model.chain.cell
        motion = run.sel(cell=run["sites/cell"].values[0]).isel(dof=[cell.host, cell.resonator])
        displacement, velocity = motion["displacement"].values, motion["velocity"].values
        middle = int(np.argmax(np.abs(displacement[:, 1] - displacement[:, 0])))
        half = round(PERIODS * np.pi / member.model.drive.frequency / field_interval(run))
        shown = slice(max(middle - half, 0), middle + half + 1)
        u, v, _ = refined(displacement[shown], velocity[shown], field_time(run)[shown])
        return cls(member.case, u, v, float(member.analysis["ibtet"]))


def phase_regimes(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Trajectories of one embedded contact cell, for every law and reading, beside the transfer curve."""
    folders: dict[str, list[Path]] = {}
    for member in transfer_members(sweeps):
        run = member.run
        if len(recorded_sites(run)) == run.sizes["site"] == 1 and "displacement" in run and "velocity" in run:
            folders.setdefault(_settings(member.case), []).append(member.folder)
    curves = {(_settings(curve.case), *sites_of(curve.case)): curve for curve in transfer_curves(sweeps)}
    for name, of_setting in folders.items():
        yield style.Drawing(name, partial(_regimes, of_setting, sweeps.files, curves))


def _settings(case: Case) -> str:
    return f"{case.contacts.law}-{Labels.of(case).page_stem}"


def _regimes(folders: Sequence[Path], files: Files, curves: Mapping[tuple[Any, ...], Curve]) -> Figure:
    motions = [ContactMotion.of(files.get(folder, MeasuredRun.open)) for folder in folders]
    motions.sort(key=lambda motion: motion.case.drive.amplitude)
    case = motions[0].case
    labels, (site,) = Labels.of(case), sites_of(case)
    columns = -(-len(motions) // 2)
    shown = f"{PERIODS} periods of the drive about the largest $|w|$"
    heading = f"{labels.law}, {case.lattice.reading}, {labels.configuration}, cell {site}; {shown}"
    figure = style.new_figure(style.PAGE, 3.4, heading)
    left, right = figure.subfigures(1, 2, width_ratios=(1, 0.62 * columns))
    transfer, panels = left.subplots(), right.subplots(2, columns, squeeze=False).ravel()
    curve = curves.get((_settings(case), site))
    if curve is not None:
        transfer.plot(curve.data["amplitude"], curve.data["ibtet"], "-o", color=style.GREY, ms=2, lw=0.7)
    for number, (axes, motion) in enumerate(zip(panels, motions, strict=False), 1):
        point = motion.case.drive.amplitude, motion.ibtet
        transfer.plot(*point, "o", color=style.RED, ms=4, zorder=3)
        note(transfer, str(number), point, (4, 3), fontsize=7.5, color=style.RED)
        displacement = 1e3 * motion.displacement
        for j, colour in ((1, style.BLUE), (0, style.RED)):
            axes.plot(displacement[:, j], motion.velocity[:, j], color=colour, lw=0.5, label=("host", "resonator")[j])
        centre_axes(axes, displacement, motion.velocity)
        axes.tick_params(labelsize=6, pad=1.5)
        axes.set(title=f"{number}: {point[0]:.4g} N", box_aspect=1)
    right.supxlabel("Displacement $u$ (mm)")
    right.supylabel(r"Velocity $\dot u$ (m/s)")
    transfer.set(xscale="log", yscale="log", xlabel="Amplitude of the drive (N)", ylabel="Inter-band transfer (1)")
    transfer.margins(x=0.08, y=0.12)
    transfer.set_title("Transfer to higher bands")
    for axes in panels[len(motions) :]:
        axes.set_axis_off()
    right.legend(handles=panels[0].get_lines(), loc="lower right", ncols=2)
    return figure
