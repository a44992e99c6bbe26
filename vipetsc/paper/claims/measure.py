"""All claims of the paper, measured from the files of its steps."""

from __future__ import annotations

from pathlib import Path

from vipetsc.paper.claims.claim import UNMEASURED, Claim, ClaimSpec, Measurement, MissingEvidence, rounded, verdict
from vipetsc.paper.claims.entropy import ENTROPY
from vipetsc.paper.claims.evidence import Evidence
from vipetsc.paper.claims.interband import INTERBAND
from vipetsc.paper.claims.modes import MODES
from vipetsc.paper.claims.scattering import SCATTERING
from vipetsc.paper.claims.thresholds import criteria_of

READINGS = "printed", "calibrated"
CLAIMS: tuple[ClaimSpec, ...] = (*SCATTERING, *ENTROPY, *INTERBAND, *MODES)


def measure_claims(root: str | Path) -> list[Claim]:
    """C1-C17 in both readings, from the steps in ``root`` (scattering/, interband/, nnm-hertz/, ...).

    What cannot be measured because its files are missing has the verdict "not measured" and says what is missing.
    """
    return [measure_claim(claim, reading, Path(root)) for claim in CLAIMS for reading in READINGS]


def measure_claim(claim: ClaimSpec, reading: str, root: Path) -> Claim:
    """One claim in one reading."""
    result, criteria = Measurement(), criteria_of(claim.id)
    judgement, missed = UNMEASURED, list[str]()
    with Evidence(root) as evidence:
        try:
            claim.measure(evidence, reading, result)
        except MissingEvidence as missing:
            result.reasons.append(str(missing))
        except (KeyError, OSError, ValueError) as error:  # files of another version, or cut off
            message = " ".join(str(error).split()).replace(f"{root}/", "")
            file = evidence.files[-1] if evidence.files else "a file"
            result.reasons.append(f"{file} cannot be used: {message}")
        else:
            judgement, missed = verdict(criteria, result.value)
    reasons = [f"not met: {' / '.join(missed)}"] if 0 < len(missed) < len(criteria) else []
    return Claim(
        claim.id,
        reading,
        claim.claim,
        rounded(result.value),
        rounded(result.uncertainty),
        "; ".join(map(str, criteria)),
        judgement,
        "; ".join([*reasons, *result.reasons]),
        result.figure or claim.figure.format(reading=reading),
        tuple(evidence.files),
    )
