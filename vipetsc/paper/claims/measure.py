"""The claims as measured: numbers from the files of the steps, and the verdicts that follow from them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from math import isfinite
from pathlib import Path

from vipetsc.io.atomic import write_text
from vipetsc.paper.claims.criteria import CLAIMS, UNMEASURED, verdict
from vipetsc.paper.claims.evidence import Evidence, Measurement, MissingEvidence, Numbers

READINGS = "printed", "calibrated"
DIGITS = 6  # significant ones of the numbers in claims.json


@dataclass(frozen=True)
class Claim:
    """A claim as measured in one reading of the paper's parameters.

    ``value`` holds named numbers, None where one could not be had, the deciding ones among them under the names that
    stand in ``threshold``; ``uncertainty`` intervals, spreads and numbers of points by name. ``figure`` is the stem of
    the picture that shows it, ``files`` are what it was measured from, relative to the folder of all steps.
    """

    id: str
    reading: str
    claim: str
    value: Numbers
    uncertainty: Numbers
    threshold: str
    verdict: str
    reason: str
    figure: str
    files: tuple[str, ...]


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


def rounded(numbers: Mapping[str, float | None]) -> Numbers:
    """``numbers`` with ``DIGITS`` significant digits; None for what is not finite."""
    return {k: float(f"{v:.{DIGITS}g}") if v is not None and isfinite(v) else None for k, v in numbers.items()}


def write_claims(claims: Sequence[Claim], path: Path) -> None:
    """Write ``claims`` as a list of JSON objects, whole or not at all; the same claims give the same bytes."""
    rows = [asdict(claim) for claim in claims]
    write_text(path, json.dumps(rows, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
