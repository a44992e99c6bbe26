"""All claims of the paper, measured from the files of its steps."""

from __future__ import annotations

from pathlib import Path

from vipetsc.paper.claims.claim import UNMEASURED, Claim, ClaimSpec, Measurement, rounded, verdict
from vipetsc.paper.claims.entropy import ENTROPY
from vipetsc.paper.claims.evidence import Evidence, MissingEvidence
from vipetsc.paper.claims.interband import INTERBAND
from vipetsc.paper.claims.modes import MODES
from vipetsc.paper.claims.scattering import SCATTERING

READINGS = "printed", "calibrated"
STATEMENTS = (*SCATTERING, *ENTROPY, *INTERBAND, *MODES)


def measure_claims(root: str | Path) -> list[Claim]:
    """C1-C17 in both readings, from the steps in ``root`` (scattering/, interband/, nnm-hertz/, ...).

    What cannot be measured because its files are missing has the verdict "not measured" and says what is missing.
    """
    return [measured(statement, reading, Path(root)) for statement in STATEMENTS for reading in READINGS]


def measured(statement: ClaimSpec, reading: str, root: Path) -> Claim:
    """One claim in one reading."""
    finding = Measurement()
    with Evidence(root) as evidence:
        try:
            statement.measure(evidence, reading, finding)
        except MissingEvidence as missing:
            found, missed = UNMEASURED, []
            finding.reasons.append(str(missing))
        except (KeyError, OSError, ValueError) as error:  # files of another version, or cut off
            found, missed = UNMEASURED, []
            words = " ".join(str(error).split()).replace(f"{root}/", "")
            finding.reasons.append(f"{evidence.files[-1] if evidence.files else 'a file'} cannot be used: {words}")
        else:
            found, missed = verdict(statement.criteria, finding.value)
        files = tuple(evidence.files)
    some = 0 < len(missed) < len(statement.criteria)
    reasons = [f"not met: {' / '.join(missed)}"] if some else []
    return Claim(
        statement.id,
        reading,
        statement.claim,
        rounded(finding.value),
        rounded(finding.uncertainty),
        statement.threshold,
        found,
        "; ".join([*reasons, *finding.reasons]),
        finding.figure or statement.figure.format(reading=reading),
        files,
    )
