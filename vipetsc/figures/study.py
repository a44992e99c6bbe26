"""What the pictures of sweeps are drawn from: finished sweeps and folders of frequency-energy branches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from vipetsc.io.ensemble_file import EnsembleFile


@dataclass(frozen=True)
class Study:
    """What pictures are drawn from: finished sweeps, and folders of frequency-energy branches."""

    ensembles: tuple[EnsembleFile, ...]
    branches: tuple[Path, ...] = ()

    @classmethod
    @contextmanager
    def open(cls, folders: Iterable[Path]) -> Iterator[Study]:
        """The sweeps and branches in ``folders``, open for the time of the block; raises OSError or ValueError."""
        with ExitStack() as stack:
            sweeps = tuple(stack.enter_context(EnsembleFile(f)) for f in folders if (f / "ensemble.h5").exists())
            yield cls(sweeps, tuple(f for f in folders if any(f.glob("branch-*.h5"))))

    def measuring(self, measure: str) -> Study:
        """The same without the sweeps that do not measure it."""
        return replace(self, ensembles=tuple(e for e in self.ensembles if measure in e.sweep.options.measures))
