"""Every number that decides on a claim, with its source: the criteria, and the constants inside of quantities.

Sections (sec., App., Suppl.) are the paper's; SPEC is the specification that fixes what the paper leaves open.
"""

from __future__ import annotations

from dataclasses import replace

from vipetsc.paper.claims.claim import Criterion

LAWS = "hertz", "bilinear"

# Constants of quantities: what is counted or measured, rather than what decides.
STRAIGHT, STRAIGHT_EVERYWHERE = 0.95, 0.9  # adjusted R^2 of a power law (SPEC 11, C7 and C8)
FEWEST = 4  # points of a fit: three lie near some power law by chance
QUIET = 0.1  # normalised entropy that is still "nearly zero" (sec. II.C)
ABRUPT = 10**0.5  # ratio of amplitudes, half a decade, in which an abrupt rise leads from QUIET to half the peak
PEAK = 0.9, 1.8  # N (sec. II.C; SPEC 4: 1.1-1.4 N)
HIGH, SEVERAL = 10.0, 3  # N, the paper's high amplitude; sites that are several
BESIDE = 0.02  # half-width of the band about a Bloch branch over the top edge of the pass bands
NATIVE = 7, 8  # wavenumber bins that the packet starts in (SPEC 11, C5)
PAPER_CELL, GRID = (0.1, 0.5), 0.1  # (lambda, eta) of the paper, spacing of its grid (SPEC 11, C10; Suppl. 3)
LOW = 10  # times the floor: up to there the transfer has not set in
SUDDEN = 10**0.5  # ratio of amplitudes from there to half the maximum
COUNTED = "band 1", "band 2", "band 3", "band 4", "gap 1", "gap 2"  # the parts that the paper filters (App. A3)
FEWEST_FOLDS = 2  # back in energy and forth again (SPEC 9)
HERTZ_LIMIT = 0.1  # d ln f / d ln E of a resonator on a spring of force w^n, n = 3/2: (n - 1)/(2 (n + 1))
SAME_MOTION, SAME_EXPONENT = 0.9, 0.2

_MOST, _NEARLY_ALL = (4, 6), (30, 36)  # of six configurations; of them at six wavenumbers (SPEC 11, C7 and C8)
_FIT = f"adjusted R^2 >= {STRAIGHT:g} over {FEWEST} points or more"


def _each_law(*criteria: Criterion) -> tuple[Criterion, ...]:
    """The criteria once for each law, whose name ends the quantity's."""
    return tuple(replace(c, quantity=f"{c.quantity}, {law}") for law in LAWS for c in criteria)


# Claim, quantity, comparison, threshold, unit, source.
THRESHOLDS: tuple[Criterion, ...] = (
    Criterion("C1", "ridge's largest distance from the optical branch", "<=", 1, "frequency bin", "SPEC 7, resolution"),
    Criterion("C1", "loudest wavenumber's distance from 5 pi/9", "<=", 1, "wavenumber bin", "SPEC 7, resolution"),
    Criterion("C2", "contact episodes at low amplitude", "<=", 0, "", "SPEC 11, C2", decisive=True),
    Criterion("C2", "largest share of the energy that changes its wavenumber", "<=", 0.01, "", "SPEC 11, C2"),
    Criterion("C3", "share at new wavenumbers, medium amplitude", ">=", 0.1, "", "sec. II.B", decisive=True),
    Criterion(
        "C3", "share at new wavenumbers, medium over low amplitude", ">=", 10, "", "sec. II.B", decisive=True
    ),
    Criterion(
        "C3", f"share within {100 * BESIDE:g} % of the top edge from the Bloch branches", ">=", 0.95, "", "SPEC 11, C3"
    ),
    Criterion("C4", "new wavenumbers, high over medium amplitude", "<=", 1, "", "SPEC 11, C4"),
    Criterion("C4", "share of the incident energy reflected, high amplitude", ">=", 0.5, "", "SPEC 11, C4: most"),
    Criterion("C5", "smallest share in bins 7 and 8, Fourier", ">=", 0.99, "", "SPEC 11, C5"),
    Criterion("C5", "smallest share in bins 7 and 8, wavelet", ">=", 0.85, "", "SPEC 11, C5; overlap of bins"),
    Criterion(
        "C6", "largest error of the reconstructed kinetic energy after the drive", "<=", 0.01, "", "SPEC 7 and 11, C6"
    ),
    Criterion("C7", "floor of the normalised entropy", "<=", QUIET, "", "sec. II.C: nearly zero"),
    Criterion("C7", "share of configurations with an abrupt rise", "of", _MOST, "", "SPEC 11, C7: most of six"),
    Criterion(
        "C7", f"share of configurations with the peak at {PEAK[0]:g} to {PEAK[1]:g} N", "of", _MOST, "", "SPEC 4, 11"
    ),
    Criterion(
        "C7", f"normalised entropy at {HIGH:g} N behind the peak, {SEVERAL} sites or more", "<=", 0.17, "", "Fig. 5"
    ),
    Criterion("C7", f"share of configurations of spread sites with {_FIT}", "of", _MOST, "", "SPEC 11, C7: most"),
    Criterion(
        "C7", f"share of configurations of neighbouring sites with {_FIT}", "of", _MOST, "", "SPEC 7; 11, C7"
    ),
    Criterion("C8", "share of curves that rise, peak and fall by half", "of", _NEARLY_ALL, "", "SPEC 11, C8"),
    Criterion(
        "C8",
        f"share of curves with adjusted R^2 >= {STRAIGHT_EVERYWHERE:g} over {FEWEST} points or more",
        "of", _NEARLY_ALL, "", "SPEC 11, C8: nearly all",
    ),
    Criterion(
        "C9",
        f"share of configurations with larger error bars from {HIGH:g} N on than at the peak",
        "of", _MOST, "", "SPEC 11, C9",
    ),
    Criterion(
        "C9",
        f"share of configurations with larger error bars from {HIGH:g} N on than without contact",
        "of", _MOST, "", "SPEC 11, C9",
    ),
    # An optimum off the paper's grid lies within half of its spacing.
    Criterion("C10", f"lambda at the optimum of a grid of {GRID:g}", "within", (0.05, 0.15), "", "SPEC 11, C10"),
    Criterion("C10", f"eta at the optimum of a grid of {GRID:g}", "within", (0.45, 0.55), "", "SPEC 11, C10"),
    Criterion(
        "C10", "u2 and u3 out of phase on band 2 at the paper's cell (1 = yes)", ">=", 1, "", "SPEC 11, C10"
    ),
    *_each_law(
        Criterion("C11", "floor", "within", (10**-4.5, 10**-3.5), "", "SPEC 11, C11: floor 1e-4"),
        Criterion("C11", "ratio of amplitudes from the floor to half the maximum", "<=", SUDDEN, "", "SPEC 11, C11"),
        Criterion("C11", "maximum", "within", (0.28, 0.36), "", "SPEC 11, C11: .30-.35, roughly"),
    ),
    *_each_law(
        Criterion("C12", "medium over low amplitude", ">=", 1, "", "SPEC 11, C12"),
        Criterion("C12", "medium over high amplitude", ">=", 1, "", "SPEC 11, C12"),
    ),
    # Any split by frequency keeps the energy of a whole record (Parseval), so the sum alone says nothing.
    Criterion("C13", "largest error of the mean over the record", "<=", 0.01, "", "SPEC 8; 11, C13", decisive=True),
    Criterion(
        "C13", "mean error over a period of the drive, largest of the runs", "<=", 0.01, "", "SPEC 8, 12", decisive=True
    ),
    Criterion(
        "C13", "largest share outside the paper's bands and gaps", "<=", 0.01, "", "SPEC 8; App. A3", decisive=True
    ),
    Criterion(
        "C13",
        "largest difference of a part's share from that in the space-time spectrum",
        "<=", 0.01, "", "SPEC 8", decisive=True,
    ),
    *_each_law(
        Criterion("C14", "maximum with one site", "within", (0.05, 0.15), "", "SPEC 11, C14: about .10"),
        Criterion("C14", "maximum with one site over that with five", "<=", 1, "", "SPEC 11, C14"),
        Criterion("C14", "correlation of 15 and 30 cycles", ">=", 0.9, "", "SPEC 11, C14: same trend"),
        Criterion("C14", "ratio of the peaks' amplitudes, 15 and 30 cycles", "<=", 2, "", "SPEC 11, C14: same trend"),
    ),
    *_each_law(
        Criterion("C15", "regions", ">=", 4, "", "SPEC 11, C15"),
        Criterion("C15", "largest |d ln f / d ln E| in region I", "<=", 1e-6, "", "SPEC 11, C15: zero slope"),
        Criterion("C15", "energy folds in region II", ">=", FEWEST_FOLDS, "", "SPEC 9; 11, C15"),
        Criterion("C15", "largest |multiplier| in region II", ">=", 1.001, "", "SPEC 11, C15: beyond rounding"),
        Criterion("C15", "adjusted R^2 of the slope in region III", ">=", 0.95, "", "SPEC 11, C15"),
    ),
    Criterion("C15", "last frequency's relative distance from the limit, bilinear", "<=", 0.01, "", "SPEC 9"),
    Criterion(
        "C15", "last d ln f / d ln E's distance from the 3/2 law's .1, hertz", "<=", 0.01, "", "SPEC 11, C15: limits"
    ),
    *_each_law(
        Criterion("C16", "adjusted R^2 in region III", ">=", 0.95, "", "SPEC 11, C16: near 1"),
        Criterion("C16", "difference of the exponents", "<=", SAME_EXPONENT, "", "SPEC 10; 11, C16: follows"),
        Criterion("C16", "mean factor between transfer and slope", "<=", 2, "", "SPEC 10; 11, C16: follows"),
    ),
    *_each_law(
        Criterion("C17", "I: correlation of host and resonator", "<=", -0.9, "", "SPEC 11, C17: linear, out of phase"),
        Criterion("C17", "II: correlation with the motion without contact", ">=", SAME_MOTION, "", "SPEC 11: grazing"),
        Criterion("C17", "III: largest share of energy above the driven band", ">=", 0.1, "", "SPEC 11: non-smooth"),
        Criterion("C17", "IV: correlation of host and resonator", ">=", 0.99, "", "SPEC 11, C17: in phase"),
        Criterion("C17", "IV: share of energy above the driven band", "<=", 0.01, "", "SPEC 11, C17: smooth again"),
    ),
)  # fmt: skip


def criteria_of(claim: str) -> tuple[Criterion, ...]:
    """The rows that decide on a claim."""
    return tuple(criterion for criterion in THRESHOLDS if criterion.claim == claim)
