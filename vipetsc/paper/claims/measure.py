"""The claims as measured: numbers from the files of the steps, and the verdicts that follow from them."""

import json
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from vipetsc.io.atomic import write_text
from vipetsc.io.errors import is_of_file_system
from vipetsc.paper.claims.criteria import CLAIMS, UNMEASURED, verdict
from vipetsc.paper.claims.evidence import Evidence, Measurement, MissingEvidence, Numbers

DIGITS = 6  # significant ones of the numbers in claims.json: further ones depend on the machine


def measure_claims(root: str | Path, unusable: Mapping[str, str] | None = None) -> list[dict[str, Any]]:
    """Measure all claims in their readings from the steps in ``root``; returns the rows of ``claims.json``.

    A row is a claim, by its ``id``, in one ``reading`` of the paper's parameters. ``value`` has numbers by name, None
    where one could not be measured; those that decide have the names of the criteria in ``threshold``. ``uncertainty``
    has intervals, spreads and numbers of points by name. ``figure`` is the stem of the picture that shows the claim;
    ``files`` are those that it was measured from, relative to ``root``. A claim whose files are missing or cannot be
    used has the verdict "not measured", and ``reason`` says why; so has one of steps that are ``unusable``, which gives
    the reasons by the names of steps.
    """
    with Evidence(root, unusable) as evidence:
        rows = []
        for claim, spec in CLAIMS.items():
            rows += [measure_claim(claim, reading, evidence) for reading in spec.readings]
        return rows


def measure_claim(claim: str, reading: str, evidence: Evidence) -> dict[str, Any]:
    """Return the row of ``claims.json`` for a claim, by its id, in one reading."""
    spec = CLAIMS[claim]
    # By its name in the table of claims, so that all about a claim stands in one place.
    measure = resolve_name(f"vipetsc.paper.claims.{spec.measure}")
    result = Measurement()
    judgement = UNMEASURED
    missed: list[str] = []
    # Emptied, since the row names the files of this claim alone.
    evidence.files = []
    try:
        measure(evidence, reading, result)
    except MissingEvidence as missing:
        result.reasons.append(str(missing))
    # Files of another version, or files that were cut off.
    except (KeyError, OSError, ValueError) as error:
        # The verdict of a claim must not depend on a disk that fails for a moment: it would be kept.
        if is_of_file_system(error):
            raise
        message = " ".join(str(error).split()).replace(f"{evidence.root}/", "")
        file = "a file"
        if evidence.files:
            file = evidence.files[-1]
        result.reasons.append(f"{file} cannot be used: {message}")
    else:
        # A claim whose measurement broke off has no verdict on the numbers that it has.
        judgement, missed = verdict(spec.criteria, result.value)

    reasons = result.reasons
    # If all criteria are missed, or none, the verdict says so already.
    if 0 < len(missed) < len(spec.criteria):
        reasons = [f"not met: {' / '.join(missed)}", *reasons]
    return {
        "id": claim,
        "reading": reading,
        "claim": spec.claim,
        "value": rounded(result.value),
        "uncertainty": rounded(result.uncertainty),
        "threshold": "; ".join(map(str, spec.criteria)),
        "verdict": judgement,
        "reason": "; ".join(reasons),
        "figure": result.figure or spec.figure.format(reading=reading),
        "files": evidence.files,
    }


def rounded(numbers: Numbers) -> dict[str, float | None]:
    """Return ``numbers`` with ``DIGITS`` significant digits; None for what is not finite."""
    short: dict[str, float | None] = {}
    for name, number in numbers.items():
        short[name] = None
        if number is not None and isfinite(number):
            short[name] = float(f"{number:.{DIGITS}g}")
    return short


def write_claims(claims: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write ``claims`` as a list of JSON objects, whole or not at all; the same claims give the same bytes."""
    # JSON has no NaN: ``rounded`` has replaced it by null.
    write_text(path, json.dumps(claims, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
