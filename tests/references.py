"""Recorded references: what an independent solver found once, kept in ``tests/references`` as ``NAME.npz``.

``scripts/test --references`` solves all of them anew, compares them with what is kept, and keeps what it finds. A
reference whose problem has changed on purpose is removed before.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parent / "references"
ANEW = "VIPETSC_REFERENCES"  # the environment variable by which scripts/test --references asks for new solutions


def recorded(name: str, problem: Iterable[Any], solve: Callable[[], np.ndarray], error: float = 1e-8) -> np.ndarray:
    """Return the solution ``name`` of a ``problem``, numbers or arrays that determine it, as ``solve`` found it.

    A new solution may differ from the kept one by ``error`` times the largest value of each of its first entries.
    """
    path = FOLDER / f"{name}.npz"
    given = np.concatenate([np.ravel(np.asarray(part, dtype=float)) for part in problem])
    if os.environ.get(ANEW):
        solution = solve()
        if path.exists():
            with np.load(path) as file:
                for found, kept in zip(solution, file["solution"], strict=True):
                    np.testing.assert_allclose(found, kept, rtol=0, atol=error * np.abs(kept).max())
        np.savez_compressed(path, problem=given, solution=solution)
        return solution

    assert path.exists(), f"no reference {name}: call scripts/test --references"
    with np.load(path) as file:
        # The last digits of a sine depend on the library that computes it.
        message = f"{path.name} is the solution of another problem: remove it, then call scripts/test --references"
        np.testing.assert_allclose(given, file["problem"], rtol=1e-12, atol=1e-300, err_msg=message)
        return np.asarray(file["solution"])
