"""C10-C14: energy that passes to higher bands of the four-band lattice (the paper's section III and supplement)."""

import tomllib
from contextlib import suppress

import numpy as np

from vipetsc.io.read import select
from vipetsc.lattice.modes import linear_modes
from vipetsc.paper.claims.criteria import CLAIMS, COUNTED, GRID, LAWS, LOW, PAPER_CELL
from vipetsc.paper.claims.evidence import AmplitudeCurve, AnalysedMember, Evidence, Measurement, MissingEvidence

STEP, AMPLITUDES, DESIGN, SCATTER = "interband", "interband-amplitudes", "design", "interband-scatter"
FIELDS = 16  # random ones, for norms


def optimum(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C10: the best (lambda, eta) of the search, on the paper's grid and on all of it (Suppl. 3, Fig. S3)."""
    search = evidence.open(DESIGN, "design.h5")
    readings, costs = (list(map(str, search[name].values)) for name in ("reading", "cost"))
    if reading not in readings:
        raise MissingEvidence(f"design has no reading {reading}")
    row, weighted = readings.index(reading), costs.index("weighted")
    lam, eta = search["lambda"].values, search["eta"].values
    phase, cost, best, paper = (
        search[name].values[row] for name in ("out_of_phase", "weighted", "optimum_value", "paper_value")
    )
    for i, name in enumerate(costs):
        for symbol in ("lambda", "eta"):
            result.value[f"{symbol} at the optimum, {name}"] = search[f"optimum_{symbol}"].values[row, i]
    # The paper searched a coarse grid; a finer one has its optimum beside.
    rows, columns = _on_grid(lam), _on_grid(eta)
    coarse = np.where(phase, cost, -np.inf)[np.ix_(rows, columns)]
    at_lam, at_eta = np.unravel_index(np.argmax(coarse), coarse.shape)
    cell = int(np.argmin(abs(lam - PAPER_CELL[0]))), int(np.argmin(abs(eta - PAPER_CELL[1])))
    result.value |= {
        f"lambda at the optimum of a grid of {GRID:g}": lam[rows][at_lam],
        f"eta at the optimum of a grid of {GRID:g}": eta[columns][at_eta],
        "u2 and u3 out of phase on band 2 at the paper's cell (1 = yes)": phase[cell],
        "weighted cost of the paper's cell over the optimum's": paper[weighted] / best[weighted],
    }
    for name, values in (("lambda", lam), ("eta", eta)):
        result.uncertainty[f"spacing of {name}"] = np.diff(values).max(initial=0.0)


def _on_grid(values: np.ndarray) -> np.ndarray:
    """Indices of the multiples of ``GRID`` among ``values``; of all of them if there are fewer than two."""
    multiples = np.nonzero(np.abs(values / GRID - np.round(values / GRID)) < 1e-6)[0]
    return multiples if multiples.size > 1 else np.arange(len(values))


def _transfer(
    evidence: Evidence, reading: str, law: str, sites: int, cycles: int, mean: str = "ibtet"
) -> AmplitudeCurve:
    return AmplitudeCurve(evidence.select(STEP, reading, law=law, sites=sites, cycles=cycles), mean)


def onset(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C11: floor, sudden onset and maximum of the transfer with five sites (Figs. 8, 9).

    The floor is that of the paper's mean, in which the record's last samples are.
    """
    maxima, inner = [], []
    for law in LAWS:
        curve, whole = (_transfer(evidence, reading, law, 5, 30, mean) for mean in ("ibtet", "ibtet_whole"))
        floors = [c.value[c.untouched].mean() if c.untouched.any() else np.nan for c in (whole, curve)]
        floor = floors[0]
        inner.append(floors[1])
        highest = curve.value.max()
        growth = curve.growth_ratio(LOW * floor, highest / 2)
        maxima.append(highest)
        result.value |= {
            f"floor, {law}": floor,
            f"floor without the record's ends, {law}": inner[-1],
            f"ratio of amplitudes from the floor to half the maximum, {law}": growth,
            f"maximum, {law}": highest,
            f"amplitude of the maximum (N), {law}": curve.peak_amplitude,
            f"transfer at the largest amplitude, {law}": curve.value[-1],
        }
        # The larger of its two neighbours shows how well the grid of amplitudes resolves the maximum.
        beside = np.sort(curve.value[max(curve.peak - 1, 0) : curve.peak + 2])[-2:][0]
        result.uncertainty[f"fall to the better neighbour of the maximum, {law}"] = highest - beside
        result.uncertainty[f"amplitudes, {law}"] = len(curve.amplitude)
        _add_scatter(evidence, reading, law, 5, result)
    result.uncertainty["spread of the maxima between the laws"] = np.ptp(maxima)
    text = "the floor is what the filters make of the record's end, not transfer: without the ends it is"
    result.reasons += [f"{text} {np.nanmax(inner):.1g}"] if np.isfinite(inner).any() else []
    lowest = next(c.interval[0] for c in CLAIMS["C11"].criteria if c.quantity.startswith("maximum"))
    if max(maxima) < lowest and reading == "printed":
        result.reasons.append("the resonator's spring lambda k of the printed equations gives less transfer")


def _add_scatter(evidence: Evidence, reading: str, law: str, sites: int, result: Measurement) -> None:
    """Mean and deviation near the maximum with clearances that scatter, where these samples were made; no criterion."""
    with suppress(MissingEvidence, KeyError):
        ensemble = evidence.ensemble(SCATTER)
        member = select(ensemble, reading=reading, law=law, sites=sites)
        share = tomllib.loads(ensemble.attrs["case"])["disorder"]["clearance"]["relative"]
        samples = f"{member['statistics/samples'].item()} samples of {100 * share:g} % clearance scatter"
        at = f"at {member['amplitude'].item():.4g} N, {law}"
        result.value[f"mean of {samples} {at}"] = member["statistics/ibtet/mean"].item()
        result.uncertainty[f"deviation of the {samples} {at}"] = member["statistics/ibtet/deviation"].item()


def medium_most(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C12: share of the upper bands at medium over low and high amplitude (Figs. 7, 8, S6)."""
    for law in LAWS:
        curve = AmplitudeCurve(evidence.select(AMPLITUDES, reading, law=law), "ibtet")
        if len(curve.amplitude) < 3:
            raise MissingEvidence(f"{AMPLITUDES} has {len(curve.amplitude)} amplitudes; low, medium, high are needed")
        index = {"low": 0, "medium": len(curve.value) // 2, "high": -1}
        share = {name: curve.value[i] for name, i in index.items()}
        result.value[f"medium over low amplitude, {law}"] = share["medium"] / share["low"]
        result.value[f"medium over high amplitude, {law}"] = share["medium"] / share["high"]
        result.value |= {f"share of the upper bands, {name}, {law}": value for name, value in share.items()}
        result.uncertainty |= {f"{name} amplitude (N)": curve.amplitude[i] for name, i in index.items()}


def bands_sum(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C13: energies of the bands and gaps against the total (App. A3, Fig. A3)."""
    runs = [run for law in LAWS for run in evidence.runs(AMPLITUDES, reading, "bands", "dispersion", law=law)]
    errors = [split_errors(run) for run in runs]
    worst = {quantity: max(error[quantity] for error in errors) for quantity in errors[0]}
    result.value |= worst | {
        "bound on the relative error of the modal energies' sum at any sample": modal_error(runs[0])
    }
    result.uncertainty["runs"] = len(runs)
    middle = sorted(run.amplitude for run in runs)[len(runs) // 2]
    result.figure = f"band_energies-hertz-{reading}-5-sites-30-cycles-{middle:.4g}N"
    beat = worst["mean error at an instant after the drive, largest of the runs"]
    text = "the parts are orthogonal over time, not at an instant: their sum beats about the total"
    modal = "the energies of the linear modes, summed by band, have no such beat"
    result.reasons.append(f"{text} by {100 * beat:.2g} % on the average in the worst run; {modal}")


def modal_error(run: AnalysedMember) -> float:
    """Bound on how far the linear modes' energies miss kinetic and spring energy, relative to these, in any motion.

    With V the modes and A the stiffness over the masses (``lattice.modes``) it is the larger of the norms of V^T V - 1
    and of Om^-1 V^T (V Om^2 V^T - A) V Om^-1: the Frobenius norms, which are not smaller, from random fields.
    """
    chain = run.case.model().chain
    modes, root = linear_modes(chain), 1 / np.sqrt(chain.masses())[:, None]
    v, frequency = modes.vectors, modes.frequency[:, None]
    x = np.random.default_rng(0).standard_normal((len(v), FIELDS))
    y = v @ (x / frequency)
    spring = v @ (frequency**2 * (v.T @ y)) - root * (chain.stiffness_matrix() @ (root * y))
    errors = v.T @ (v @ x) - x, v.T @ spring / frequency
    return float(max(np.sqrt(np.sum(error**2) / FIELDS) for error in errors))


def split_errors(run: AnalysedMember) -> dict[str, float]:
    """How the parts of one run (energies over time, by frequency filters) miss what they should add up to.

    The means over the record agree for any complete split without overlap (Parseval). Over a period of the drive they
    agree where no motion straddles an edge; judged in the inner part of the record, a burst away from its ends, where
    the filters see less than a period. The shares must be those of an independent spectrum, the space-time one, and
    lie in the parts that the paper counts.
    """
    names = ("bands/sample", "bands/edges", "bands/energy", "bands/total", "frequency", "dispersion")
    time, edges, energy, total, frequency, dispersion = run.arrays(*names)
    drive, parts = run.case.model().drive, energy.sum(axis=0)
    samples = min(max(round(2 * np.pi / drive.frequency / (time[1] - time[0])), 1), len(time))
    window = np.full(samples, 1 / samples)
    middle, mean_parts, mean_total = (np.convolve(x, window, "valid") for x in (time, parts, total))
    inner = (middle >= drive.duration) & (middle <= time[-1] - drive.duration)
    after = time >= drive.duration
    if not inner.any():
        raise MissingEvidence(f"{run.folder.name}: the record is no longer than two bursts")
    share = energy.mean(axis=1) / energy.mean(axis=1).sum()
    part = np.searchsorted(edges, frequency, side="right") - 1
    spectrum = np.bincount(part, dispersion.sum(axis=0), len(share))
    counted = np.isin(np.atleast_1d(run.analysis["bands/energy"].attrs["parts"]), COUNTED)
    over_period = np.abs(mean_parts[inner] / mean_total[inner] - 1)
    at_instants = np.abs(parts[after] - total[after]) / total[after]
    beside_spectrum = np.abs(share - spectrum / spectrum.sum())
    return {
        "largest error of the mean over the record": abs(parts.mean() / total.mean() - 1),
        "mean error over a period of the drive, largest of the runs": over_period.mean(),
        "largest share outside the paper's bands and gaps": share[~counted].sum(),
        "largest difference of a part's share from that in the space-time spectrum": beside_spectrum.max(),
        "mean error at an instant after the drive, largest of the runs": at_instants.mean(),
    }


def one_site(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C14: maximum with one site; 15 beside 30 cycles (Fig. 9, Suppl.)."""
    for law in LAWS:
        many, short, single = (_transfer(evidence, reading, law, *kind) for kind in ((5, 30), (5, 15), (1, 30)))
        shared, i, j = np.intersect1d(many.amplitude, short.amplitude, return_indices=True)
        logarithms = np.log(many.value[i]), np.log(short.value[j])
        correlation = np.corrcoef(*logarithms)[0, 1] if len(shared) > 2 else np.nan
        peaks = many.peak_amplitude, short.peak_amplitude
        result.value |= {
            f"maximum with one site, {law}": single.value.max(),
            f"maximum with one site over that with five, {law}": single.value.max() / many.value.max(),
            f"correlation of 15 and 30 cycles, {law}": correlation,
            f"ratio of the peaks' amplitudes, 15 and 30 cycles, {law}": max(peaks) / min(peaks),
            f"maximum with 15 cycles, {law}": short.value.max(),
        }
        result.uncertainty[f"amplitudes, {law}"] = len(shared)
        _add_scatter(evidence, reading, law, 1, result)


def prediction(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C18: what five sites transfer, composed from the answer of one site, beside simulations."""
    for law in LAWS:
        data = evidence.open(f"prediction-{law}", "prediction.h5", needs=("predicted", "simulated"))
        touched = (
            data["simulated/contact_episodes"].values > 0,
            data["amplitude"].values > data.attrs["onset_amplitude"],
        )
        result.value |= {
            f"rms of the upper bands' energy at the end, in decades, {law}": data.attrs["rms_upper"],
            f"largest error of the dissipated share, {law}": data.attrs["worst_dissipated"],
            f"amplitudes with contact on one side alone, {law}": int(np.sum(touched[0] != touched[1])),
            f"largest error of the upper bands' energy, in decades, {law}": data.attrs["worst_upper"],
        }
        result.uncertainty[f"amplitudes, {law}"] = data.sizes["amplitude"]
