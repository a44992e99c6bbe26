"""Inter-band transfer over the amplitude (paper, Fig. 9), next to a branch (Figs. 12, S7, S8), and its regimes.

The *floor* of a curve is the transfer without any contact. A curve that is *related* to a branch is drawn over the work
of the drive, scaled so that contact begins at the branch's energy of grazing, next to the branch's slope df/dE
(``vipetsc.studies.backbone``).
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case, Model, Sweep
from vipetsc.case.amplitude import drive_unit
from vipetsc.figures import style
from vipetsc.figures.page import Page
from vipetsc.figures.panels import note, quantile_band, recorded_sites, shade_regions
from vipetsc.figures.runs import centre_axes, refined
from vipetsc.figures.series import Series
from vipetsc.figures.style import Drawing
from vipetsc.figures.sweep_members import (
    AMPLITUDE,
    Files,
    Labels,
    MemberRun,
    Sweeps,
    grouped,
    phrase,
    reading_of_case,
    sites_of,
    transfer_members,
    varied_at,
)
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import curves, field_interval, field_time
from vipetsc.spectra import doubt

MARKERS = "os^Dv"  # of configurations
FEWEST = 6  # amplitudes of a curve that is drawn: two each below, near and beyond the peak
PERIODS = 10  # of the drive in a phase portrait: more turns would cover each other
REACH = 6  # end of the linear panels over the amplitude of the peak; the logarithmic ones show all
BACKBONE_LABEL = "Inter-band transfer, normalised slope (1)"


class TransferCurve(NamedTuple):
    """Measures (member,) of one law, reading and configuration by name; ``case`` is that of one of its members."""

    case: Case
    data: Mapping[Any, Any]


def transfer_curves(sweeps: Sweeps) -> Iterator[TransferCurve]:
    """Yield the curves over rising amplitude of all sweeps with at least ``FEWEST`` amplitudes of finite transfer.

    ``peak`` is the index of the largest "ibtet", ``floor`` the transfer without any contact, NaN if all members touch.
    """
    for ensemble in sweeps:
        if "ibtet" not in ensemble:
            continue
        sweep = Sweep.of(ensemble)
        for row, number in curves(ensemble, AMPLITUDE):
            case = sweep.case(number)
            data = row.sortby(AMPLITUDE)
            transfer = data["ibtet"].values
            if sites_of(case) and np.isfinite(transfer).sum() >= FEWEST:
                floor = np.nan
                untouched = transfer[data["contact_episodes"].values == 0]
                if untouched.size:
                    floor = untouched.mean()
                yield TransferCurve(case, data.assign(floor=floor, peak=int(np.nanargmax(transfer))))


def columns_of_laws(shown: Sequence[TransferCurve], ylabel: str, panel: Callable[[Axes, TransferCurve], str]) -> Figure:
    """Draw a page of one configuration: a column for each law, drawn by ``panel``, which returns its title."""
    shown = sorted(shown, key=lambda curve: curve.case.contacts.law, reverse=True)
    width = 4.3
    if len(shown) > 1:
        width = style.PAGE
    varied = str(shown[0].data.get("varied", ""))
    heading = Labels.of(shown[0].case, varied).page
    page = Page.of(columns=len(shown), width=width, height=2.9, heading=heading, sharey=True)
    for axes, curve in zip(page.panels, shown, strict=True):
        axes.set_title(panel(axes, curve))
    page.panels[0].set_ylabel(ylabel)
    return page.lettered()


def sampled_points(sweeps: Sweeps) -> Iterator[TransferCurve]:
    """Yield the configurations of sweeps over samples of disorder at one amplitude, each as a curve of one point."""
    for ensemble in sweeps:
        if "statistics/ibtet/mean" in ensemble and AMPLITUDE not in ensemble.sizes:
            numbers = ensemble["number"]
            for index in np.ndindex(*numbers.shape):
                point = ensemble.isel(dict(zip(numbers.dims, index, strict=True)))
                yield TransferCurve(Sweep.of(ensemble).case(int(point["number"])), point)


def ibtet(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each reading, with a column for each law: linear near the peaks, and logarithmic throughout."""
    points = list(sampled_points(sweeps))
    by_reading = grouped(transfer_curves(sweeps), lambda curve: curve.case.lattice.reading)
    for reading, page_curves in by_reading.items():
        page_points = [point for point in points if point.case.lattice.reading == reading]
        yield Drawing(reading, partial(_page, reading, page_curves, page_points))


class _Look(NamedTuple):
    """The label, colour and marker of a configuration on all panels of a page."""

    label: str
    colour: str
    marker: str


def _page(reading: str, page_curves: Sequence[TransferCurve], points: Sequence[TransferCurve]) -> Figure:
    """Draw the transfer over the amplitude: a column a law, linear about the peaks above, logarithmic below."""
    laws = sorted({curve.case.contacts.law for curve in page_curves}, reverse=True)
    kinds = list(dict.fromkeys(Labels.of(curve.case).configuration for curve in page_curves))
    looks = {kind: _Look(kind, f"C{i}", MARKERS[i % len(MARKERS)]) for i, kind in enumerate(kinds)}
    page = Page.of(2, len(laws), height=4.6, sharey="row")
    page.body.supxlabel("Amplitude of the drive (N)")
    page.body.supylabel("Inter-band transfer (1)")

    for (linear, logarithmic), law in zip(page.grid.T, laws, strict=True):
        law_curves = [curve for curve in page_curves if curve.case.contacts.law == law]
        for row, curve in enumerate(law_curves):
            kind = Labels.of(curve.case).configuration
            for axes in (linear, logarithmic):
                _draw_curve(axes, curve, looks[kind], name_band=row == 0)
            for point in points:
                if point.case.contacts.law == law and Labels.of(point.case).configuration == kind:
                    _draw_sampled(linear, point, looks[kind])
            _mark_peak(linear, curve, looks[kind], row)

        reach = max(REACH * curve.data[AMPLITUDE][curve.data["peak"]] for curve in law_curves)
        linear.set(title=f"{law.capitalize()}, {reading}", xlim=(0, float(reach)))
        logarithmic.set(title=f"{law.capitalize()}, {reading}", xscale="log", yscale="log")
        logarithmic.legend(loc="upper right")

    # The limits of all columns, once all is drawn: their axes are common.
    page.grid[0, 0].set_ylim(0, None)
    page.grid[1, 0].set_ylim(None, 6.0)
    return page.lettered()


def _draw_curve(axes: Axes, curve: TransferCurve, look: _Look, name_band: bool) -> None:
    """Draw the transfer over the amplitude, its quantiles over samples as a band, and the floor dashed."""
    amplitudes = np.asarray(curve.data[AMPLITUDE])
    line = {"color": look.colour, "marker": look.marker, "ms": 2.2, "lw": 0.7}
    drawn = Series(
        amplitudes,
        np.asarray(curve.data["ibtet"]),
        line,
        look.label,
        band=quantile_band(curve.data, "ibtet"),
        band_label="5 to 95 % of samples" if name_band else "",
    )
    drawn.draw(axes)
    floor = float(curve.data["floor"])
    if np.isfinite(floor):
        axes.axhline(floor, color=look.colour, lw=0.6, ls=style.DASHED, zorder=1)


def _draw_sampled(axes: Axes, point: TransferCurve, look: _Look) -> None:
    """Draw mean and deviation over the samples at one amplitude."""
    mean = point.data["statistics/ibtet/mean"].item()
    deviation = point.data["statistics/ibtet/deviation"].item()
    bar = {"color": look.colour, "mec": style.BLACK, "mew": 0.4, "ms": 3.5, "capsize": 2, "zorder": 5}
    axes.errorbar(point.case.drive.amplitude, mean, deviation, fmt="D", label="mean ± std of samples", **bar)
    axes.legend(handles=axes.containers[:1], loc="center right")


def _mark_peak(axes: Axes, curve: TransferCurve, look: _Look, row: int) -> None:
    """Mark the largest value by a ring, and write it in line ``row``, from 0, of the text in the panel."""
    peak = curve.data["peak"]
    amplitude = np.asarray(curve.data[AMPLITUDE])[peak]
    largest = np.asarray(curve.data["ibtet"])[peak]
    axes.plot(amplitude, largest, "o", mfc="none", mec=look.colour, ms=6, mew=0.7)
    text = f"largest: {largest:.3f} at {amplitude:.3g} N"
    axes.text(0.97, 0.94 - 0.09 * row, text, ha="right", va="top", color=look.colour, transform=axes.transAxes)


def ibtet_backbone(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each reading and configuration in ``backbone.h5``, with laws in columns."""
    for ensemble in sweeps:
        path = Path(ensemble.attrs["folder"]) / "backbone.h5"
        if not path.exists():
            continue
        with open_netcdf(path, "backbone", ("case",)) as file:
            values = {**file.attrs, **{name: variable.values for name, variable in file.variables.items()}}
        # The file stays when a sweep is computed again with another case: its curves are of the former one.
        if values["case"] != ensemble.attrs["case"]:
            continue

        aligned = []
        for table in _groups(values):
            varied = varied_at(int(table["number"]), ensemble) if "number" in table else ""
            aligned.append(TransferCurve(Case.from_toml(table["case"]), {**table, "varied": varied}))
        for name, columns in grouped(aligned, _backbone_page_stem).items():
            yield Drawing(name, partial(columns_of_laws, columns, BACKBONE_LABEL, _superposition))


def _backbone_page_stem(curve: TransferCurve) -> str:
    """Return the stem of the page of a related curve: by all that its sweep varies but the law."""
    return Labels.of(curve.case, curve.data["varied"]).page_stem


def curves_left_out(folders: Iterable[Path]) -> str:
    """Return a message on the curves of the sweeps in ``folders`` that could not be related to branches; or ""."""
    sentences: list[str] = []
    for path in (folder / "backbone.h5" for folder in folders):
        if path.exists():
            with open_netcdf(path, "backbone", ("case",)) as file:
                sentences += json.loads(file.attrs.get("left_out", "[]"))
    return "; ".join(dict.fromkeys(sentences))


def _groups(values: Mapping[Any, Any]) -> list[dict[str, Any]]:
    """Return the values of each group of a file by their paths within the group; values outside any are left out."""
    groups: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        group, separator, name = str(path).partition("/")
        if separator:
            groups.setdefault(group, {})[name] = value
    return list(groups.values())


def _superposition(axes: Axes, aligned: TransferCurve) -> str:
    """Draw a lattice's transfer and its branch's slope over normalised energy, and return the panel's title.

    Blue points are the lattice's transfer; the power law in green was fitted to the red ones, in region III. The dashed
    line is the branch's slope over the divisor with which it fits the transfer, the grey line the same with the floor
    added.
    """
    curve = aligned.data
    energy = curve["energy"]
    transfer = curve["ibtet"]
    fitted = curve["fitted"].astype(bool)
    branch = curve["branch/energy"]
    region = curve["branch/region"]
    grazing = curve["grazing_energy"]
    floor = curve["floor"]
    slope = np.where(region == 1, 0.0, curve["branch/slope"]) / curve["divisor"]
    # The fit takes the parts where the frequency rises with the energy.
    rising = np.where(slope > 0, slope, np.nan)
    falling = np.where(slope < 0, -slope, np.nan)
    left = 0.5 * min(energy.min(), 0.1 * grazing)
    right = 2 * energy.max()

    # Region I goes on to the left of the branch, with a slope of zero as well.
    extended = np.append(left, branch)
    with_floor = floor + np.append(0.0, np.where(slope < 0, np.nan, slope))
    axes.plot(extended, with_floor, color=style.GREY, lw=2.2, alpha=0.55, label="slope + floor")
    label = f"slope, $E^{{{curve['slope_exponent']:.2f}}}$ there"
    axes.plot(branch, rising, color=style.BLACK, lw=0.8, ls=style.DASHED, label=label)
    if np.isfinite(falling).any():
        axes.plot(branch, falling, color=style.BLACK, lw=0.8, ls=style.DOTTED, label="slope < 0, not fitted")

    axes.plot(energy, transfer, "-o", color=style.BLUE, ms=2.6, mfc="white", mew=0.6, lw=0.6, label="lattice")
    axes.plot(energy[fitted], transfer[fitted], "o", color=style.RED, ms=2.8, label="in region III")

    power_law = curve["factor"] * energy[fitted] ** curve["exponent"]
    label = f"$E^{{{curve['exponent']:.2f}}}$, adj. $R^2$ {curve['r2_adjusted']:.3f}"
    doubts = doubt(fitted.sum(), curve["r2_adjusted"])
    if doubts:
        power_law = np.full_like(power_law, np.nan)
        label = f"no power law: {doubts}"
    axes.plot(energy[fitted], power_law, color=style.GREEN, lw=1.4, zorder=4, label=label)

    # Region I is shaded up to grazing, not only to the last point of the branch before it.
    shaded = np.minimum(np.where(region == 1, grazing, branch), right)
    shade_regions(axes, shaded, region, left, at_top=False)
    axes.set(xscale="log", yscale="log", xlabel="Normalised energy (J)", xlim=(left, right), ylim=(0.25 * floor, 4.0))
    axes.legend(loc="upper right", fontsize=6)
    law = Labels.of(aligned.case).law
    return f"{law}; branch of the {curve['branch_reading']} reading" if aligned.case.lattice.preset else law


class ContactMotion(NamedTuple):
    """``displacement`` in m and ``velocity`` in m/s (t, 2) of a contact's host and resonator, and the transfer."""

    case: Case
    displacement: np.ndarray
    velocity: np.ndarray
    ibtet: float

    @classmethod
    def of(cls, member: MemberRun) -> Self:
        """Return the motion of ``member`` for ``PERIODS`` of the drive about its largest relative displacement."""
        run = member.run
        displacement = _of_contact(run, member.model, "displacement")
        velocity = _of_contact(run, member.model, "velocity")

        # The motion at its strongest: earlier the wave has not come, later it has left.
        middle = int(np.argmax(np.abs(displacement[:, 1] - displacement[:, 0])))
        half = round(PERIODS * np.pi / member.model.drive.frequency / field_interval(run))
        shown = slice(max(middle - half, 0), middle + half + 1)
        u, v, _ = refined(displacement[shown], velocity[shown], field_time(run)[shown])
        return cls(case=member.case, displacement=u, velocity=v, ibtet=float(member.analysis["ibtet"]))


def _of_contact(run: xr.Dataset, model: Model, quantity: str) -> np.ndarray:
    """Return a ``quantity`` (t, 2) of the host and the resonator of the first contact; 0 for one with the ground."""
    pair = model.chain.sites[0].pair
    cell = int(run["sites/cell"].values[0])
    resonator_cell = int(model.chain.topology.neighbour(cell - 1, pair.offset)) + 1
    resonator = run[quantity].sel(cell=resonator_cell).isel(dof=pair.resonator).values
    host = np.zeros_like(resonator)
    if pair.host >= 0:
        host = run[quantity].sel(cell=cell).isel(dof=pair.host).values
    return np.stack([host, resonator], axis=1)


def phase_regimes(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each law and reading: trajectories of the one contact cell, next to the transfer curve."""
    folders: dict[tuple[str, Labels], list[Path]] = {}
    for member in transfer_members(sweeps):
        run = member.run
        shows_its_site = len(recorded_sites(run)) == run.sizes["site"] == 1
        if shows_its_site and "displacement" in run and "velocity" in run:
            # Members that differ in the amplitude only are on one page.
            labels = member.labels._replace(member="", member_stem="", amplitude="")
            folders.setdefault((f"{member.case.contacts.law}-{labels.page_stem}", labels), []).append(member.folder)

    curves_by_site = {
        (f"{curve.case.contacts.law}-{Labels.of(curve.case).page_stem}", *sites_of(curve.case)): curve
        for curve in transfer_curves(sweeps)
    }
    for (name, labels), page_folders in folders.items():
        # Where the sweep varies a further key, curves have other names than the page: it is then drawn without one.
        members = [sweeps.files.get(folder, MemberRun.open) for folder in page_folders]
        (site,) = sites_of(members[0].case)
        curve = curves_by_site.get((name, site))
        shown = [member.shown(member.labels.amplitude) for member in members]
        yield Drawing(name, partial(_regimes, page_folders, sweeps.files, labels, curve), shown)


def _regimes(folders: Sequence[Path], files: Files, labels: Labels, curve: TransferCurve | None) -> Figure:
    """Draw the transfer over the amplitude with the members numbered, and the portrait of each next to it."""
    motions = [ContactMotion.of(files.get(folder, MemberRun.open)) for folder in folders]
    motions.sort(key=lambda motion: motion.case.drive.amplitude)
    case = motions[0].case
    (site,) = sites_of(case)
    unit = drive_unit(case.drive)
    columns = -(-len(motions) // 2)
    window = f"{PERIODS} periods of the drive about the largest $|w|$"
    heading = f"{phrase(labels.law, reading_of_case(case), labels.configuration, f'cell {site}')}; {window}"
    figure = style.new_figure(style.PAGE, 3.4, heading)
    left, right = figure.subfigures(1, 2, width_ratios=(1, 0.62 * columns))
    transfer = left.subplots()
    panels = right.subplots(2, columns, squeeze=False).ravel()

    if curve is not None:
        transfer.plot(curve.data["amplitude"], curve.data["ibtet"], "-o", color=style.GREY, ms=2, lw=0.7)
    for number, (axes, motion) in enumerate(zip(panels, motions, strict=False), 1):
        point = motion.case.drive.amplitude, motion.ibtet
        transfer.plot(*point, "o", color=style.RED, ms=4, zorder=3)
        note(transfer, str(number), point, (4, 3), fontsize=7.5, color=style.RED)
        _draw_portrait(axes, motion)
        axes.set(title=f"(b.{number}) {motion.case.drive.amplitude:.4g} {unit}", box_aspect=1)
    for axes in panels[len(motions) :]:
        axes.set_axis_off()

    transfer.set(xscale="log", yscale="log")
    transfer.set(xlabel=f"Amplitude of the drive ({unit})", ylabel="Inter-band transfer (1)")
    transfer.margins(x=0.08, y=0.12)
    # By hand: the numbers of the panels are those of the points in the first one.
    transfer.set_title("(a) Transfer to higher bands")
    right.supxlabel("Displacement $u$ (mm)\nblue: resonator, red and dashed: host")
    right.supylabel(r"Velocity $\dot u$ (m/s)")
    return figure


def _draw_portrait(axes: Axes, motion: ContactMotion) -> None:
    """Draw velocity over displacement in mm, the host on top of the resonator."""
    displacement = 1e3 * motion.displacement
    axes.plot(displacement[:, 1], motion.velocity[:, 1], color=style.BLUE, lw=0.5, label="resonator")
    axes.plot(displacement[:, 0], motion.velocity[:, 0], color=style.RED, lw=0.5, ls=style.DASHED, label="host")
    centre_axes(axes, displacement, motion.velocity)
    axes.tick_params(labelsize=6, pad=1.5)
