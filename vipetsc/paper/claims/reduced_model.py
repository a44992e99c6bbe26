"""C15-C17: the reduced model's frequency-energy branches and the lattice (the paper's section IV and supplement)."""

import json

import numpy as np
import xarray as xr

from vipetsc.case import NnmCase
from vipetsc.io.read import field_interval, nearest_cell, open_run
from vipetsc.lattice import pass_bands, waves_at
from vipetsc.modes.branches.branch import KINDS
from vipetsc.modes.system import System
from vipetsc.paper.claims.criteria import FEWEST_FOLDS, HERTZ_LIMIT, LAWS, SAME_EXPONENT, SAME_MOTION
from vipetsc.paper.claims.evidence import AnalysedMember, Evidence, Measurement, MissingEvidence
from vipetsc.studies.backbone import BRANCH, log_slope
from vipetsc.wording import counted

# Steps of the paper's plan.
INTERBAND = "interband"
ONE_SITE = "interband-one-site"
MAIN = "5-sites-30-cycles"
IN_PHASE = "branch-in-phase.h5"
# Numbers of tongues and special points of the in-phase branch at the printed 100 MPa, up to the energy ``HIGHEST`` (J).
# Steps of a third of the usual ones find no more.
HIGHEST = 6e9
EXPECTED_COUNTS = {
    "hertz": {"tongues": 17, "grazing": 316, "symmetry-breaking": 62, "period-doubling": 41, "fold-energy": 90},
    "bilinear": {"tongues": 15, "grazing": 187, "fold-energy": 132},
}


def branches(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C15: slope, folds and stability over regions I-IV of the out-of-phase branch (Fig. 11).

    Raises MissingEvidence if results are missing, or are of another law or reading.
    """
    for law in LAWS:
        step = f"nnm-{law}"
        if reading != "printed":
            step += f"-{reading}"
        branch = evidence.open(step, BRANCH)
        case = NnmCase.from_toml(branch.attrs["case"])
        if case.lattice.reading != reading or case.contacts.law != law:
            raise MissingEvidence(f"{step} holds a branch of the law {case.contacts.law}, {case.lattice.reading}")
        _add_out_of_phase(branch, case, law, result)
        if reading == "printed" and (evidence.root / step / IN_PHASE).exists():
            in_phase = evidence.open(step, IN_PHASE, needs=("kind", "energy", "frequency", "resonance"))
            _add_in_phase(in_phase, law, result)


def _add_out_of_phase(branch: xr.Dataset, case: NnmCase, law: str, result: Measurement) -> None:
    """Add slope, folds and stability of the out-of-phase ``branch`` of a ``case`` to ``result``, region by region."""
    names = ("energy", "frequency", "slope", "region", "multiplier_max", "kind")
    energy, frequency, slope, region, multiplier, kind = (branch[name].values for name in names)
    regular = kind == 0
    # |d ln f / d ln E|
    steepness = np.abs(slope * energy / frequency)
    first = np.nonzero((region == 1) & regular)[0]
    last = np.nonzero(regular)[0][-1]
    folds = int(np.sum((kind == KINDS.index("fold-energy")) & (region == 2)))
    fit = json.loads(branch.attrs["fits"]).get("III", {})
    energy_of_contact = None
    if first.size:
        energy_of_contact = energy[first[-1]]
    result.value |= {
        f"regions, {law}": len(set(region[region > 0].tolist())),
        f"largest |d ln f / d ln E| in region I, {law}": _largest(steepness[first]),
        f"energy folds in region II, {law}": folds,
        f"largest |multiplier| in region II, {law}": _largest(multiplier[region == 2]),
        f"adjusted R^2 of the slope in region III, {law}": fit.get("adjusted_r2"),
        f"exponent of the slope in region III, {law}": fit.get("exponent"),
        f"last frequency (Hz), {law}": frequency[last],
        f"energy at the end of region I (J), {law}": energy_of_contact,
    }
    result.uncertainty[f"points in region III, {law}"] = fit.get("points", 0)
    result.uncertainty[f"energy of the last point (J), {law}"] = energy[last]

    if law == "bilinear":
        # At high energy a bilinear contact is closed nearly all of the time, and the system is linear, with the contact
        # as a further spring.
        limit = System.from_case(case).closed_frequencies()[-1] / (2 * np.pi)
        result.value["high-energy limit (Hz), bilinear"] = limit
        distance = abs(frequency[last] / limit - 1)
        result.value["last frequency's relative distance from the limit, bilinear"] = distance
    else:
        distance = abs(steepness[last] - HERTZ_LIMIT)
        result.value["last d ln f / d ln E's distance from the 3/2 law's .1, hertz"] = distance
    if folds < FEWEST_FOLDS:
        of_branch = f"the {law} branch"
        if case.contacts.modulus:
            of_branch += f" at {case.contacts.modulus / 1e6:g} MPa"
        result.reasons.append(f"{of_branch} has {folds} energy folds at grazing")


def _add_in_phase(branch: xr.Dataset, law: str, result: Measurement) -> None:
    """Add tongues, special points and largest frequency of the in-phase ``branch`` to ``result``.

    A reason is added for each number that differs from ``EXPECTED_COUNTS``.
    """
    # Up to the energy of ``EXPECTED_COUNTS``: a branch that was followed further has more.
    passed = branch["energy"].values <= HIGHEST
    kind, tongue, frequency = (branch[name].values[passed] for name in ("kind", "resonance", "frequency"))
    counts = {name: int(np.sum(kind == KINDS.index(name))) for name in EXPECTED_COUNTS[law] if name != "tongues"}
    counts["tongues"] = len(set(tongue[tongue > 1].tolist()))
    result.value |= {f"{name} of the in-phase branch, {law}": count for name, count in counts.items()}
    result.value[f"largest frequency (Hz) of the in-phase branch, {law}"] = frequency.max()
    for name, count in counts.items():
        if count != EXPECTED_COUNTS[law][name]:
            result.reasons.append(f"the {law} branch in phase has {count} {name}, not {EXPECTED_COUNTS[law][name]}")


def _largest(values: np.ndarray) -> float | None:
    """Return the largest of the ``values`` that are finite; None if none is."""
    if not np.isfinite(values).any():
        return None
    return float(np.nanmax(values))


def follows_slope(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C16: power law of the transfer in region III compared with that of the branch's slope (Figs. 12, S7, S8).

    Raises MissingEvidence if there is no relation of the transfer to a branch in this reading.
    """
    relation = evidence.open(INTERBAND, "backbone.h5")
    left_out: list[str] = json.loads(relation.attrs.get("left_out", "[]"))
    curves = sorted({str(name).partition("/")[0] for name in relation.variables if str(name).startswith(f"{reading}-")})
    if not any(name.startswith(f"{reading}-{law}-{MAIN}") for name in curves for law in LAWS):
        raise MissingEvidence("; ".join([f"backbone.h5 holds no curve of the reading {reading}", *left_out]))

    for name in curves:
        _, law, sites, _, cycles, _ = name.split("-")
        main = name.endswith(MAIN)
        label = law
        if not main:
            label = f"{law}, {counted(sites, 'site')}, {cycles} cycles"
        about = {k.removeprefix(f"{name}/"): v for k, v in relation.attrs.items() if k.startswith(f"{name}/")}
        difference = abs(about["exponent"] - about["slope_exponent"])
        fitted = relation[f"{name}/fitted"].values.astype(bool)
        energy, ibtet = (relation[f"{name}/{key}"].values[fitted] for key in ("energy", "ibtet"))
        branch = (relation[f"{name}/branch/{key}"].values for key in ("energy", "slope", "region"))

        # The logarithm of the transfer over slope/divisor + floor, as the picture draws it. The mean factor is exp of
        # its root mean square.
        ratio = np.log(ibtet / (np.exp(log_slope(energy, *branch)) / about["divisor"] + about["floor"]))
        result.value |= {
            f"adjusted R^2 in region III, {label}": about["r2_adjusted"],
            f"exponent of the transfer, {label}": about["exponent"],
            f"exponent of the slope, {label}": about["slope_exponent"],
            f"mean factor between transfer and slope, {label}": np.exp(np.sqrt(np.mean(ratio**2))),
            f"difference of the exponents, {label}": difference,
        }
        interval = (about["exponent_high"] - about["exponent_low"]) / 2
        result.uncertainty[f"transfer exponent's 95 % interval (+/-), {label}"] = interval
        result.uncertainty[f"points of the fit, {label}"] = fitted.sum()
        if main and difference > SAME_EXPONENT:
            result.reasons.append(
                f"{law}: the transfer falls as E^{about['exponent']:.2f}, the slope there as"
                f" E^{about['slope_exponent']:.2f}"
            )
        if about["branch_reading"] != reading:
            result.reasons.append(f"{label}: the branch has the reading {about['branch_reading']}")
    result.reasons += [text for text in left_out if text.startswith(reading)]


def portraits(evidence: Evidence, reading: str, result: Measurement) -> None:
    """C17: regimes of the motion of host and resonator at the only site of the lattice (Suppl., Figs. S4, S5).

    Raises MissingEvidence if results are missing, or have no runs without contact and with it.
    """
    for law in LAWS:
        runs = evidence.runs(ONE_SITE, reading, law=law)
        host, resonator, above = zip(*(pair_motion(evidence, run) for run in runs), strict=True)
        correlation = [np.corrcoef(*pair)[0, 1] for pair in zip(host, resonator, strict=True)]
        touching = [i for i, run in enumerate(runs) if run.episodes]
        if len(touching) < 2 or runs[0].episodes:
            raise MissingEvidence(f"{ONE_SITE}, {law}: one amplitude without contact and two with are needed")

        first = touching[0]
        last = touching[-1]
        grazing = np.corrcoef(resonator[first], resonator[0])[0, 1]
        result.value |= {
            f"I: correlation of host and resonator, {law}": correlation[0],
            f"II: correlation with the motion without contact, {law}": grazing,
            f"III: largest fraction of energy above the driven band, {law}": max(above[i] for i in touching),
            f"IV: correlation of host and resonator, {law}": correlation[last],
            f"IV: fraction of energy above the driven band, {law}": above[last],
        }
        result.value |= {f"correlation at {runs[i].amplitude:g} N, {law}": correlation[i] for i in touching[:-1]}
        result.uncertainty[f"amplitudes, {law}"] = len(runs)
        if grazing < SAME_MOTION:
            run = runs[first]
            beyond = 100 * (run.amplitude / run.onset - 1)
            excess = ""
            if np.isfinite(beyond):
                excess = f", {beyond:.2g} % above first contact,"
            text = f"{law}: at {run.amplitude:g} N{excess} the resonator's motion has already left the linear one"
            result.reasons.append(text)


def pair_motion(evidence: Evidence, run: AnalysedMember) -> tuple[np.ndarray, np.ndarray, float]:
    """Return velocities (t,) in m/s of host and resonator at a ``run``'s only site, and the share of fast motion.

    The fraction is that of the pair's kinetic energy at frequencies above the driven band, over the whole record under
    a Hann window. Raises MissingEvidence if the site's velocity was not recorded.
    """
    model = run.case.model()
    cell = model.chain.cell
    pair = [cell.host, cell.resonator]
    with open_run(evidence.path(ONE_SITE, run.folder.name, "run.h5")) as fields:
        site = int(fields["sites/cell"].values[0])
        index = nearest_cell(fields, site)
        interval = field_interval(fields)
        if "velocity" not in fields or fields["cell"].values[index] != site:
            raise MissingEvidence(f"the velocity of cell {site} was not recorded")
        velocity = fields["velocity"][:, index].values[:, pair]

    spectrum = np.abs(np.fft.rfft(velocity * np.hanning(len(velocity))[:, None], axis=0)) ** 2
    energy = spectrum @ np.asarray(cell.masses)[pair]
    frequency = 2 * np.pi * np.fft.rfftfreq(len(velocity), interval)
    waves = waves_at(cell, model.drive.frequency)
    # A drive in a gap has no band, and its own frequency divides slow from fast.
    edge = model.drive.frequency
    if waves:
        edge = pass_bands(cell)[waves[0][0] - 1].high
    return *velocity.T, energy[frequency > edge].sum() / energy.sum()
