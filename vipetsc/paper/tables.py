"""What the verb ``paper`` prints: how far a plan has come, and the verdicts on the claims."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vipetsc.paper.make import FORMATS, duration, inputs_of, read_record
from vipetsc.paper.plan import Plan
from vipetsc.paper.steps import DONE, MISSING, STALE


def plan_table(plan: Plan, root: Path, ranks: int) -> str:
    """What is done and what is left of ``plan`` in ``root``: steps with the time they need, figures, claims."""
    lines, total = [f"{'step':<26}{'state':<10}{'left':>9}  claims"], 0.0
    for step in plan.steps:
        left = step.left(root) / ranks
        total += left
        lines.append(f"{step.name:<26}{step.state(root):<10}{duration(left):>9}  {' '.join(plan.claims_of(step))}")
    lines += [f"{'all steps on ' + str(ranks) + (' ranks' if ranks > 1 else ' rank'):<36}{duration(total):>9}", ""]
    lines.append(f"{'figure':<8}{'paper':<9}{'pictures':<10}{'state':<9}claims      shows")
    record, inputs = read_record(root)["figures"], inputs_of(plan, root)
    for figure in plan.figures:
        unrecorded = {path.stem for path in (root / "figures").glob(f"{figure.id}-*")}
        entry = record.get(figure.id, {"inputs": "", "pictures": unrecorded})
        paths = [root / "figures" / f"{stem}.{kind}" for stem in entry["pictures"] for kind in FORMATS]
        drawn = [path for path in paths if path.exists()]
        current = len(drawn) == len(paths) and entry["inputs"] == inputs[figure.id]
        state = MISSING if not drawn else DONE if current else STALE
        lines.append(
            f"{figure.id:<8}{figure.label:<9}{len(drawn) // len(FORMATS):<10}{state:<9}"
            f"{' '.join(figure.claims):<12}{figure.title}"
        )
    return "\n".join(lines)


def claims_table(claims: Sequence[dict[str, Any]]) -> str:
    """Claims in rows, readings in columns, verdicts in words."""
    readings = list(dict.fromkeys(claim["reading"] for claim in claims))
    lines = [f"{'':<5}" + "".join(f"{reading:<18}" for reading in readings) + "claim"]
    for key in dict.fromkeys(claim["id"] for claim in claims):
        rows = {claim["reading"]: claim for claim in claims if claim["id"] == key}
        verdicts = "".join(f"{rows[r]['verdict'] if r in rows else '':<18}" for r in readings)
        lines.append(f"{key:<5}{verdicts}{next(iter(rows.values()))['claim']}")
    return "\n".join(lines)
