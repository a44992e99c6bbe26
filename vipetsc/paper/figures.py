"""Every figure of the paper and its supplement: what it is drawn from, what it shows, which claims it bears on."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures.backbone import backbone
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.registry import FIGURES, study_drawings
from vipetsc.figures.schematics import lattice_page, reduced_model
from vipetsc.figures.study import Study
from vipetsc.io.netcdf import open_netcdf
from vipetsc.lattice.presets import PRESETS

READINGS = "calibrated", "printed"
MEDIUM = "24.33N"  # in the names of members of the four-band lattice at the amplitude that the paper calls medium
LAWS = "hertz", "bilinear"


@dataclass(frozen=True)
class Part:
    """Pictures of one kind, from the folders of ``steps``: ``offers`` yields what those that are there allow."""

    steps: tuple[str, ...]
    offers: Callable[[Mapping[str, Path]], Iterator[Drawing]]


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper; ours are one or more pictures, for every reading (and law, and average).

    ``id`` begins the names of their files, ``label`` is the paper's number, ``caption`` says in our words what is
    seen, ``claims`` are those that it bears on.
    """

    id: str
    label: str
    title: str
    caption: str
    claims: tuple[str, ...]
    parts: tuple[Part, ...]

    @property
    def steps(self) -> tuple[str, ...]:
        """The steps whose results the figure shows."""
        return tuple(dict.fromkeys(step for part in self.parts for step in part.steps))

    def offers(self, folders: Mapping[str, Path]) -> Iterator[Drawing]:
        """The stems and drawings that the ``folders`` (step -> folder) of finished steps allow."""
        for part in self.parts:
            there = {step: folders[step] for step in part.steps if step in folders}
            for stem, make in part.offers(there) if there or not part.steps else ():
                yield f"{self.id}-{stem}", make


def _study(family: str, *steps: str, only: Collection[str] = (), prefix: str = "") -> Part:
    """The pictures of a family of sweeps whose name holds all the words of ``only``."""

    def offers(folders: Mapping[str, Path]) -> Iterator[Drawing]:
        study = Study.read(folders.values())
        for stem, make in study_drawings(study, [family]) if study.ensembles else ():
            if all(f"-{word}-" in f"{stem}-" for word in only):
                yield prefix + stem, make

    return Part(steps, offers)


def _search(*names: str) -> Part:
    def page(path: Path, name: str) -> Figure:
        with open_netcdf(path, "search") as search:
            figure: Figure = FIGURES[name].function(search)
        return figure

    def offers(folders: Mapping[str, Path]) -> Iterator[Drawing]:
        for name in names:
            yield f"design-{name.replace('_', '-')}", partial(page, folders["design"] / "design.h5", name)

    return Part(("design",), offers)


def _branches(name: str, reading: str) -> Part:
    """The branch ``name`` of both laws side by side."""
    steps = [f"nnm-{law}{'' if reading == 'printed' else '-calibrated'}" for law in LAWS]

    def offers(folders: Mapping[str, Path]) -> Iterator[Drawing]:
        paths = [folder / f"branch-{name}.h5" for folder in folders.values()]
        there = [path for path in paths if path.exists()]
        if there:
            yield f"branches-{name}-{reading}", lambda: backbone(there)

    return Part(tuple(steps), offers)


def _lattices(preset: str, sites: tuple[int, ...]) -> Part:
    def offers(folders: Mapping[str, Path]) -> Iterator[Drawing]:
        for reading in READINGS:
            yield f"{preset}-lattice-{reading}", partial(lattice_page, _case(preset, reading), sites)

    return Part((), offers)


def _models() -> Part:
    def page(reading: str) -> Figure:
        cell, preset = _case("four-band", reading).unit_cell(), PRESETS["four-band"]
        masses = cell.masses[cell.host], cell.masses[cell.resonator]
        inner = [s.stiffness for s in cell.springs if {s.start, s.end} == {cell.host, cell.resonator}]
        # Half of the total of springs that are held at their middles, as the paper shares them out.
        outer = [s.stiffness for s in cell.springs if cell.host in (s.start, s.end) and s.stiffness not in inner]
        return reduced_model(masses, (sum(outer), sum(inner)), preset.clearances(1)[0])

    def offers(folders: Mapping[str, Path]) -> Iterator[Drawing]:
        for reading in READINGS:
            yield f"reduced-model-{reading}", partial(page, reading)

    return Part((), offers)


def _case(preset: str, reading: str) -> Case:
    return Case.from_table({"name": preset, "lattice": {"preset": preset, "reading": reading}})


def words(stem: str) -> str:
    """What a picture's file name says, in words: "calibrated reading, 5π/9, energy-weighted average"."""
    found = []
    if "neighbours" in stem:
        found.append("neighbouring sites")
    found += [law for law in ("Hertz", "bilinear") if law.lower() in stem.split("-")]
    found += [name.replace("-", " ") for name in ("out-of-phase", "in-phase") if name in stem][:1]
    found += [f"{reading} reading" for reading in READINGS if reading in stem]
    found += [f"{m[1]}π/{m[2]}" for m in re.finditer(r"(\d+)pi-(\d+)", stem)]
    found += [f"{m[1]} site{'s' if m[1] != '1' else ''}" for m in re.finditer(r"(\d+)-sites?", stem)]
    found += [f"{m[1]} cycles" for m in re.finditer(r"([\d.]+)-cycles", stem)]
    found += [f"{m[1]} N" for m in re.finditer(r"-([\d.e+]+)N(?:-|$)", stem)]
    averages = {"energy_weighted": "energy-weighted", "masked": "masked", "joint": "joint"}
    found += [f"{text} average" for name, text in averages.items() if stem.endswith(name)]
    return ", ".join(found)


WHOLE, CURVES, NEAR = "scattering-amplitudes", "scattering", "scattering-neighbours"
TRIO, TRANSFER, ONE = "interband-amplitudes", "interband", "interband-one-site"
FIVE_NINTHS = ("5pi-9",)

PAPER_FIGURES: Sequence[PaperFigure] = (
    PaperFigure(
        "fig01", "Fig. 1", "The diatomic lattice",
        "A host with a resonator inside it that may strike two stops; its two bands with the drive at 5π/9 on the "
        "optical one; the lattice of 600 cells with 1 to 20 contact sites, clearances falling from 0.2 to 0.1 mm.",
        ("C1",), (_lattices("diatomic", (1, 2, 3, 5, 10, 20)),),
    ),
    PaperFigure(
        "fig02", "Fig. 2", "Wavenumber scattering at three amplitudes",
        "Diatomic lattice, Hertz contacts at five sites, drive at 5π/9. Columns: low, medium and high amplitude. Rows: "
        "kinetic energy in space-time, wavenumber content over time, dispersion of the whole run with the Bloch "
        "branches dashed. Energies are divided by the amplitude squared, so what differs is nonlinear.",
        ("C1", "C2", "C3", "C4"), (_study("amplitudes", WHOLE),),
    ),
    PaperFigure(
        "fig03", "Fig. 3", "Wavelet transform in space at four times",
        "Morlet wavelets of the host velocity of the runs of Fig. 2: rows are times before, at and behind the sites, "
        "columns amplitudes; the black line is the wavenumber of the linear wave.",
        ("C3", "C4"), (_study("wavelets", WHOLE),),
    ),
    PaperFigure(
        "fig04", "Fig. 4", "Energy by wavenumber bin",
        "The medium-amplitude run cut into twelve wavenumber bins: energy of seven of them in space-time to one "
        "scale, contours of all twelve at three amplitudes, and the optical band in the colours of the bins.",
        ("C5",), (_study("partition", WHOLE),),
    ),
    PaperFigure(
        "fig05", "Fig. 5", "Mean wavenumber entropy against amplitude",
        "Diatomic lattice, Hertz contacts, drive at 5π/9, each configuration normalised to [0.01, 1]; linear scales "
        "above, logarithmic below with the power law fitted from the peak on and both adjusted R². Three averages "
        "are shown because a plain mean over all cells and times sees mostly silence; error bars are the deviation "
        "over the cells. Sites are spread, and next to one another from cell 301 on.",
        ("C7", "C9"),
        (_study("entropy", CURVES, only=FIVE_NINTHS), _study("entropy", NEAR, prefix="neighbours-")),
    ),
    PaperFigure(
        "fig06", "Fig. 6", "The four-band lattice",
        "Its cell with the contact pair in the middle, its four bands with the drive where the second is fastest, and "
        "the lattice of 300 cells with five sites and with one. The readings differ in the resonator's spring.",
        (), (_lattices("four-band", (5, 1)),),
    ),
    PaperFigure(
        "fig07", "Fig. 7", "Inter-band transfer with Hertz contacts",
        "Four-band lattice, five sites, 24.33 N: all energy and that of every pass band in space-time, dispersion of "
        "the cells before and behind the first site, and spectra of the four masses of a cell before and behind, pass "
        "bands shaded.",
        ("C12",), (_study("transfer", TRIO, only=("hertz", MEDIUM)),),
    ),
    PaperFigure(
        "fig08", "Fig. 8", "Dispersion of whole runs",
        "Four-band lattice, five sites: both laws in rows, 1, 24.33 and 200 N in columns, each over its own largest "
        "value; Bloch branches dashed.",
        ("C11", "C12"), (_study("transfer_dispersions", TRIO),),
    ),
    PaperFigure(
        "fig09", "Fig. 9", "Transferred energy against amplitude",
        "Share of the kinetic energy in the two upper bands, averaged over the time after the wave reaches the first "
        "site, for both laws; five sites with 30 and 15 cycles, and one site; dashed: the floor of the linear wave.",
        ("C11", "C12", "C14"), (_study("ibtet", TRANSFER),),
    ),
    PaperFigure(
        "fig10", "Fig. 10", "The reduced model",
        "Host and resonator of one contact cell, the host held by half of the total of its neighbours' springs.",
        (), (_models(),),
    ),
    PaperFigure(
        "fig11", "Fig. 11", "Frequency-energy branches",
        "Branches of the reduced model for both laws: frequency, with the transition at grazing in the inset and "
        "unstable parts coloured; slope df/dE; orbits in regions I to IV. The paper plots the out-of-phase branch; the "
        "in-phase one threads the internal resonances with it.",
        ("C15",),
        (*(_branches("out-of-phase", r) for r in READINGS), _branches("in-phase", "printed")),
    ),
    PaperFigure(
        "fig12", "Fig. 12", "Transfer beside the slope of the branch",
        "Transfer of the four-band lattice (dots; red where fitted) over energy, scaled so that the first contact "
        "falls on grazing; slope of the out-of-phase branch over a divisor (dashed) and with the linear floor "
        "(grey); power law over region III (green). Five sites, 30 cycles.",
        ("C16",), (_study("ibtet_backbone", TRANSFER, only=("5-sites-30-cycles",)),),
    ),
    PaperFigure(
        "fig13", "Fig. A1", "Kinetic energy from the wavenumber bins",
        "Kinetic energy, that of the sum of the twelve bins' velocities, their relative error (1 % dashed), and the "
        "share between bins, which a plain sum of the bins' energies would lose.",
        ("C6",), (_study("reconstruction", WHOLE),),
    ),
    PaperFigure(
        "fig14", "Fig. A2", "Wavenumber entropy in time",
        "Entropy over cells and time at three amplitudes with its energy-weighted mean on top, and that mean over "
        "time and amplitude for every configuration at 5π/9.",
        ("C3", "C7"), (_study("entropy_maps", WHOLE), _study("entropy_history", CURVES, only=FIVE_NINTHS)),
    ),
    PaperFigure(
        "fig15", "Fig. A3", "Energies of the pass bands",
        "Energy of every pass band and gap over time, their sum against the total with its error, and their shares "
        "against amplitude. The paper leaves out the gap between the two upper bands and what lies above; they are "
        "counted here.",
        ("C13",),
        (*(_study("band_energies", TRIO, only=(law, MEDIUM)) for law in LAWS),
         _study("band_energies", TRANSFER, only=("shares",))),
    ),
    PaperFigure(
        "figS1", "Fig. S1", "How the wavenumber partition is made",
        "A snapshot, its wavelet transform cut into bins, the inverse of some of them, and their energy in space-time.",
        ("C5", "C6"), (_study("partition_explained", WHOLE),),
    ),
    PaperFigure(
        "figS2", "Fig. S2", "Mean entropy for every wavenumber and configuration",
        "As the lower row of Fig. 5: drive wavenumbers in rows, contact sites in columns, with both adjusted R².",
        ("C8",), (_study("entropy_all", CURVES),),
    ),
    PaperFigure(
        "figS3", "Fig. S3", "Search for the four-band cell",
        "Bloch deflections at the best cell, and the three costs over (λ, η) with the best cell marked and its bands "
        "inset; both readings. Cells where u₂ and u₃ do not move against each other on band 2 are left blank.",
        ("C10",), (_search("deflections", "cost_maps", "dispersion_against_lambda", "dispersion_against_eta"),),
    ),
    PaperFigure(
        "figS4", "Fig. S4", "Phase portraits of one Hertz contact cell in the lattice",
        "Host and resonator of the only contact site over ten periods of the drive about the largest deflection, from "
        "grazing to hard contact, and where these runs lie on the transfer curve.",
        ("C17",), (_study("phase_regimes", ONE, TRANSFER, only=("hertz",)),),
    ),
    PaperFigure(
        "figS5", "Fig. S5", "Phase portraits of one bilinear contact cell in the lattice",
        "As Fig. S4 with bilinear contacts.",
        ("C17",), (_study("phase_regimes", ONE, TRANSFER, only=("bilinear",)),),
    ),
    PaperFigure(
        "figS6", "Fig. S6", "Inter-band transfer with bilinear contacts",
        "As Fig. 7 with bilinear contacts.",
        ("C12",), (_study("transfer", TRIO, only=("bilinear", MEDIUM)),),
    ),
    PaperFigure(
        "figS7", "Fig. S7", "Transfer beside the slope of the branch, 15 cycles",
        "As Fig. 12 for a burst of 15 cycles.",
        ("C14", "C16"), (_study("ibtet_backbone", TRANSFER, only=("5-sites-15-cycles",)),),
    ),
    PaperFigure(
        "figS8", "Fig. S8", "Transfer beside the slope of the branch, one site",
        "As Fig. 12 for one contact site.",
        ("C14", "C16"), (_study("ibtet_backbone", TRANSFER, only=("1-site-30-cycles",)),),
    ),
)  # fmt: skip
