"""Every figure of the paper and its supplement: what it is drawn from, what it shows, which claims it bears on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from vipetsc.figures import registry
from vipetsc.paper.pictures import Drawn, PaperFigure, Schematic, lattice, two_masses

DIATOMIC, ENTROPY, NEIGHBOURS = "scattering-amplitudes", "scattering", "scattering-neighbours"
FOUR_BAND, TRANSFER, ONE_SITE = "interband-amplitudes", "interband", "interband-one-site"
PRINTED, CALIBRATED = ("nnm-hertz", "nnm-bilinear"), ("nnm-hertz-calibrated", "nnm-bilinear-calibrated")
RELATED = (*PRINTED, *CALIBRATED)  # branches that the transfer is laid over
MEDIUM = "24.33N"  # in the names of members of the four-band lattice at the amplitude that the paper calls medium
FIVE_NINTHS = ("5pi-9",)

_sweep = partial(Drawn, registry.SWEEP)
_branches = partial(Drawn, registry.BRANCHES, "branch")
_related = partial(_sweep, "ibtet_backbone", (TRANSFER,), behind=RELATED)
SEARCH = tuple(
    Drawn(registry.DESIGN, name, ("design",), stem=f"design-{name.replace('_', '-')}")
    for name in ("deflections", "cost_maps", "dispersion_against_lambda", "dispersion_against_eta")
)

PAPER_FIGURES: Sequence[PaperFigure] = (
    PaperFigure(
        "fig01", "Fig. 1", "The diatomic lattice",
        "A host with a resonator inside it that may strike two stops; its two bands with the drive at 5π/9 on the "
        "optical one; the lattice of 600 cells with 1 to 20 contact sites, clearances falling from 0.2 to 0.1 mm.",
        ("C1",), (Schematic("diatomic-lattice", partial(lattice, "diatomic", (1, 2, 3, 5, 10, 20))),),
    ),
    PaperFigure(
        "fig02", "Fig. 2", "Wavenumber scattering at three amplitudes",
        "Diatomic lattice, Hertz contacts at five sites, drive at 5π/9. Columns: low, medium and high amplitude. Rows: "
        "kinetic energy in space-time, wavenumber content over time, dispersion of the whole run with the Bloch "
        "branches dashed. Energies are divided by the amplitude squared, so what differs is nonlinear.",
        ("C1", "C2", "C3", "C4"), (_sweep("amplitudes", (DIATOMIC,)),),
    ),
    PaperFigure(
        "fig03", "Fig. 3", "Wavelet transform in space at four times",
        "Morlet wavelets of the host velocity of the runs of Fig. 2: rows are times before, at and behind the sites, "
        "columns amplitudes; the black line is the wavenumber of the linear wave.",
        ("C3", "C4"), (_sweep("wavelets", (DIATOMIC,)),),
    ),
    PaperFigure(
        "fig04", "Fig. 4", "Energy by wavenumber bin",
        "The medium-amplitude run cut into twelve wavenumber bins: energy of seven of them in space-time to one "
        "scale, contours of all twelve at three amplitudes, and the optical band in the colours of the bins.",
        ("C5",), (_sweep("partition", (DIATOMIC,)),),
    ),
    PaperFigure(
        "fig05", "Fig. 5", "Mean wavenumber entropy against amplitude",
        "Diatomic lattice, Hertz contacts, drive at 5π/9, each configuration normalised to [0.01, 1]; linear scales "
        "above, logarithmic below with the power law fitted from the peak on and both adjusted R². Three averages "
        "are shown because a plain mean over all cells and times sees mostly silence; error bars are the deviation "
        "over the cells. Sites are spread, and next to one another from cell 301 on.",
        ("C7", "C9"),
        (_sweep("entropy", (ENTROPY,), FIVE_NINTHS), _sweep("entropy", (NEIGHBOURS,), stem="neighbours-{stem}")),
    ),
    PaperFigure(
        "fig06", "Fig. 6", "The four-band lattice",
        "Its cell with the contact pair in the middle, its four bands with the drive where the second is fastest, and "
        "the lattice of 300 cells with five sites and with one. The readings differ in the resonator's spring.",
        (), (Schematic("four-band-lattice", partial(lattice, "four-band", (5, 1))),),
    ),
    PaperFigure(
        "fig07", "Fig. 7", "Inter-band transfer with Hertz contacts",
        "Four-band lattice, five sites, 24.33 N: all energy and that of every pass band in space-time, dispersion of "
        "the cells before and behind the first site, and spectra of the four masses of a cell before and behind, pass "
        "bands shaded.",
        ("C12",), (_sweep("transfer", (FOUR_BAND,), ("hertz", MEDIUM)),),
    ),
    PaperFigure(
        "fig08", "Fig. 8", "Dispersion of whole runs",
        "Four-band lattice, five sites: both laws in rows, 1, 24.33 and 200 N in columns, each over its own largest "
        "value; Bloch branches dashed.",
        ("C11", "C12"), (_sweep("transfer_dispersions", (FOUR_BAND,)),),
    ),
    PaperFigure(
        "fig09", "Fig. 9", "Transferred energy against amplitude",
        "Share of the kinetic energy in the two upper bands, averaged over the time after the wave reaches the first "
        "site, for both laws; five sites with 30 and 15 cycles, and one site; dashed: the floor of the linear wave.",
        ("C11", "C12", "C14"), (_sweep("ibtet", (TRANSFER,)),),
    ),
    PaperFigure(
        "fig10", "Fig. 10", "The reduced model",
        "Host and resonator of one contact cell, the host held by half of the total of its neighbours' springs.",
        (), (Schematic("reduced-model", two_masses),),
    ),
    PaperFigure(
        "fig11", "Fig. 11", "Frequency-energy branches",
        "Branches of the reduced model for both laws: frequency, with the transition at grazing in the inset and "
        "unstable parts coloured; slope df/dE; orbits in regions I to IV. The paper plots the out-of-phase branch; the "
        "in-phase one threads the internal resonances with it.",
        ("C15",),
        (_branches(CALIBRATED, ("out-of-phase",), "branches-out-of-phase-calibrated"),
         _branches(PRINTED, ("out-of-phase",), "branches-out-of-phase-printed"),
         _branches(PRINTED, ("in-phase",), "branches-in-phase-printed")),
    ),
    PaperFigure(
        "fig12", "Fig. 12", "Transfer beside the slope of the branch",
        "Transfer of the four-band lattice (dots; red where fitted) over energy, scaled so that the first contact "
        "falls on grazing; slope of the out-of-phase branch over a divisor (dashed) and with the linear floor "
        "(grey); power law over region III (green). Five sites, 30 cycles.",
        ("C16",), (_related(("5-sites-30-cycles",)),),
    ),
    PaperFigure(
        "fig13", "Fig. A1", "Kinetic energy from the wavenumber bins",
        "Kinetic energy, that of the sum of the twelve bins' velocities, their relative error (1 % dashed), and the "
        "share between bins, which a plain sum of the bins' energies would lose.",
        ("C6",), (_sweep("reconstruction", (DIATOMIC,)),),
    ),
    PaperFigure(
        "fig14", "Fig. A2", "Wavenumber entropy in time",
        "Entropy over cells and time at three amplitudes with its energy-weighted mean on top, and that mean over "
        "time and amplitude for every configuration at 5π/9.",
        ("C3", "C7"), (_sweep("entropy_maps", (DIATOMIC,)), _sweep("entropy_history", (ENTROPY,), FIVE_NINTHS)),
    ),
    PaperFigure(
        "fig15", "Fig. A3", "Energies of the pass bands",
        "Energy of every pass band and gap over time, their sum against the total with its error, and their shares "
        "against amplitude. The paper leaves out the gap between the two upper bands and what lies above; they are "
        "counted here.",
        ("C13",),
        (_sweep("band_energies", (FOUR_BAND,), ("hertz", MEDIUM)),
         _sweep("band_energies", (FOUR_BAND,), ("bilinear", MEDIUM)),
         _sweep("band_energies", (TRANSFER,), ("shares",))),
    ),
    PaperFigure(
        "figS1", "Fig. S1", "How the wavenumber partition is made",
        "A snapshot, its wavelet transform cut into bins, the inverse of some of them, and their energy in space-time.",
        ("C5", "C6"), (_sweep("partition_explained", (DIATOMIC,)),),
    ),
    PaperFigure(
        "figS2", "Fig. S2", "Mean entropy for every wavenumber and configuration",
        "As the lower row of Fig. 5: drive wavenumbers in rows, contact sites in columns, with both adjusted R².",
        ("C8",), (_sweep("entropy_all", (ENTROPY,)),),
    ),
    PaperFigure(
        "figS3", "Fig. S3", "Search for the four-band cell",
        "Bloch deflections at the best cell, and the three costs over (λ, η) with the best cell marked and its bands "
        "inset; both readings. Cells where u₂ and u₃ do not move against each other on band 2 are left blank.",
        ("C10",), SEARCH,
    ),
    PaperFigure(
        "figS4", "Fig. S4", "Phase portraits of one Hertz contact cell in the lattice",
        "Host and resonator of the only contact site over ten periods of the drive about the largest deflection, from "
        "grazing to hard contact, and where these runs lie on the transfer curve.",
        ("C17",), (_sweep("phase_regimes", (ONE_SITE, TRANSFER), ("hertz",)),),
    ),
    PaperFigure(
        "figS5", "Fig. S5", "Phase portraits of one bilinear contact cell in the lattice",
        "As Fig. S4 with bilinear contacts.",
        ("C17",), (_sweep("phase_regimes", (ONE_SITE, TRANSFER), ("bilinear",)),),
    ),
    PaperFigure(
        "figS6", "Fig. S6", "Inter-band transfer with bilinear contacts",
        "As Fig. 7 with bilinear contacts.",
        ("C12",), (_sweep("transfer", (FOUR_BAND,), ("bilinear", MEDIUM)),),
    ),
    PaperFigure(
        "figS7", "Fig. S7", "Transfer beside the slope of the branch, 15 cycles",
        "As Fig. 12 for a burst of 15 cycles.",
        ("C14", "C16"), (_related(("5-sites-15-cycles",)),),
    ),
    PaperFigure(
        "figS8", "Fig. S8", "Transfer beside the slope of the branch, one site",
        "As Fig. 12 for one contact site.",
        ("C14", "C16"), (_related(("1-site-30-cycles",)),),
    ),
)  # fmt: skip
