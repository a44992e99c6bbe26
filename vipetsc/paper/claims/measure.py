"""The claims as measured: numbers from the files of the steps, and the verdicts that follow from them."""

import json
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from vipetsc.io.atomic import write_text
from vipetsc.paper.claims.criteria import CLAIMS, UNMEASURED, verdict
from vipetsc.paper.claims.evidence import Evidence, Measurement, MissingEvidence, Numbers

DIGITS = 6  # significant ones of the numbers in claims.json: further ones depend on the machine


def measure_claims(root: str | Path) -> list[dict[str, Any]]:
    """C1-C17 in both readings and C18 in one, from the steps in ``root`` (scattering/, interband/, nnm-hertz/, ...).

    A row of ``claims.json`` is a claim in one ``reading`` of the paper's parameters. ``value`` holds named numbers,
    None where one could not be had, the deciding ones among them under their names in ``threshold``;
    ``uncertainty`` intervals, spreads and numbers of points by name. ``figure`` is the stem of the picture that shows
    the claim, ``files`` are what it was measured from, relative to ``root``. What cannot be measured because its files
    are missing has the verdict "not measured", and ``reason`` says what is missing.
    """
    with Evidence(root) as evidence:
        rows = []
        for claim, spec in CLAIMS.items():
            rows += [measure_claim(claim, reading, evidence) for reading in spec.readings]
        return rows


def measure_claim(claim: str, reading: str, evidence: Evidence) -> dict[str, Any]:
    """Row of ``claims.json`` for a claim, by its id, in one reading."""
    spec = CLAIMS[claim]
    # By name, so that the table of claims says all about a claim, its measurement too.
    measure = resolve_name(f"vipetsc.paper.claims.{spec.measure}")
    result = Measurement()
    judgement = UNMEASURED
    missed: list[str] = []
    evidence.files = []  # those of this claim alone are named in its row
    try:
        measure(evidence, reading, result)
    except MissingEvidence as missing:
        result.reasons.append(str(missing))
    except (KeyError, OSError, ValueError) as error:  # files of another version, or cut off
        message = " ".join(str(error).split()).replace(f"{evidence.root}/", "")
        file = "a file"
        if evidence.files:
            file = evidence.files[-1]
        result.reasons.append(f"{file} cannot be used: {message}")
    else:
        # A claim whose measurement broke off has no verdict on the numbers that it has.
        judgement, missed = verdict(spec.criteria, result.value)

    reasons = result.reasons
    # Where all or none are missed the verdict says it already.
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
    """``numbers`` with ``DIGITS`` significant digits; None for what is not finite."""
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
