"""All claims of the paper, measured from the files of its steps."""

from importlib import import_module
from pathlib import Path

from vipetsc.paper.claims.claim import UNMEASURED, Claim, Measurement, MissingEvidence, rounded, verdict
from vipetsc.paper.claims.evidence import Evidence
from vipetsc.paper.claims.thresholds import CLAIMS

READINGS = "printed", "calibrated"


def measure_claims(root: str | Path) -> list[Claim]:
    """C1-C17 in both readings, from the steps in ``root`` (scattering/, interband/, nnm-hertz/, ...).

    What cannot be measured because its files are missing has the verdict "not measured" and says what is missing.
    """
    return [measure_claim(claim, reading, Path(root)) for claim in CLAIMS for reading in READINGS]


def measure_claim(claim: str, reading: str, root: Path) -> Claim:
    """One claim, by its id, in one reading."""
    result, spec = Measurement(), CLAIMS[claim]
    judgement, missed = UNMEASURED, list[str]()
    module, _, name = spec.measure.partition(".")
    function = getattr(import_module(f"vipetsc.paper.claims.{module}"), name)
    with Evidence(root) as evidence:
        try:
            function(evidence, reading, result)
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
