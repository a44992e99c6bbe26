"""All claims of the paper, measured from the files of its steps."""

from collections.abc import Callable
from pathlib import Path

from vipetsc.paper.claims import entropy, interband, modes, scattering
from vipetsc.paper.claims.claim import UNMEASURED, Claim, Measurement, MissingEvidence, rounded, verdict
from vipetsc.paper.claims.evidence import Evidence
from vipetsc.paper.claims.thresholds import CLAIMS

READINGS = "printed", "calibrated"
# Each fills the measurement from the evidence in one reading, and raises MissingEvidence when it cannot.
MEASURES: dict[str, Callable[[Evidence, str, Measurement], None]] = {
    "C1": scattering.optical_ridge,
    "C2": scattering.linear_content,
    "C3": scattering.new_wavenumbers,
    "C4": scattering.reflected,
    "C5": scattering.native_bins,
    "C6": scattering.reconstruction,
    "C7": entropy.power_law,
    "C8": entropy.everywhere,
    "C9": entropy.error_bars,
    "C10": interband.optimum,
    "C11": interband.onset,
    "C12": interband.medium_most,
    "C13": interband.bands_sum,
    "C14": interband.one_site,
    "C15": modes.branches,
    "C16": modes.follows_slope,
    "C17": modes.portraits,
}


def measure_claims(root: str | Path) -> list[Claim]:
    """C1-C17 in both readings, from the steps in ``root`` (scattering/, interband/, nnm-hertz/, ...).

    What cannot be measured because its files are missing has the verdict "not measured" and says what is missing.
    """
    return [measure_claim(claim, reading, Path(root)) for claim in MEASURES for reading in READINGS]


def measure_claim(claim: str, reading: str, root: Path) -> Claim:
    """One claim, by its id, in one reading."""
    result, spec = Measurement(), CLAIMS[claim]
    judgement, missed = UNMEASURED, list[str]()
    with Evidence(root) as evidence:
        try:
            MEASURES[claim](evidence, reading, result)
        except MissingEvidence as missing:
            result.reasons.append(str(missing))
        except (KeyError, OSError, ValueError) as error:  # files of another version, or cut off
            message = " ".join(str(error).split()).replace(f"{root}/", "")
            file = evidence.files[-1] if evidence.files else "a file"
            result.reasons.append(f"{file} cannot be used: {message}")
        else:
            judgement, missed = verdict(spec.criteria, result.value)
    reasons = [f"not met: {' / '.join(missed)}"] if 0 < len(missed) < len(spec.criteria) else []
    return Claim(
        claim,
        reading,
        spec.claim,
        rounded(result.value),
        rounded(result.uncertainty),
        "; ".join(map(str, spec.criteria)),
        judgement,
        "; ".join([*reasons, *result.reasons]),
        result.figure or spec.figure.format(reading=reading),
        tuple(evidence.files),
    )
