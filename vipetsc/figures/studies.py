"""The pictures of finished sweeps by name, and the drawing of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from vipetsc.figures import style
from vipetsc.figures.band_energies import band_energies
from vipetsc.figures.entropy import entropy, entropy_all
from vipetsc.figures.entropy_time import entropy_history, entropy_maps
from vipetsc.figures.explained import partition_explained
from vipetsc.figures.partition import partition, reconstruction
from vipetsc.figures.regimes import phase_regimes
from vipetsc.figures.registry import chosen, draw_each
from vipetsc.figures.scattering import amplitudes, wavelets
from vipetsc.figures.style import Drawing
from vipetsc.figures.transfer import transfer
from vipetsc.figures.transfer_backbone import ibtet_backbone
from vipetsc.figures.transfer_curves import ibtet
from vipetsc.figures.transfer_dispersions import transfer_dispersions
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


# Each offers what its data allow.
StudyFigure = Callable[[Study], Iterator[Drawing]]

# By what a sweep measures; a sweep is shown only by the figures of its own measures.
_FAMILIES: dict[str, tuple[StudyFigure, ...]] = {
    "entropy": (
        amplitudes,
        wavelets,
        partition,
        partition_explained,
        reconstruction,
        entropy,
        entropy_all,
        entropy_maps,
        entropy_history,
    ),
    "transfer": (
        transfer,
        transfer_dispersions,
        band_energies,
        ibtet,
        ibtet_backbone,
        phase_regimes,
    ),
}
study_figures: dict[str, StudyFigure] = {f.__name__: f for family in _FAMILIES.values() for f in family}
_MEASURE = {f.__name__: measure for measure, family in _FAMILIES.items() for f in family}


def draw_study(
    folders: Sequence[Path],
    names: Sequence[str] | None = None,
    formats: Sequence[str] = ("png",),
    share: tuple[int, int] = (0, 1),
) -> list[Path]:
    """Draw the sweeps (and branches) in ``folders`` into ``figures/`` of the first of them.

    Parameters
    ----------
    names
        Which of ``study_figures``; by default all that the data allow.
    share
        (rank, size): draw every ``size``-th picture from ``rank`` on, so that ranks can share the work.

    Returns
    -------
    list of Path
        The files written, each complete or not there at all.

    Raises
    ------
    KeyError
        For a name that is not in ``study_figures``; says the nearest one.
    OSError, ValueError
        If a file cannot be read, or a picture not written.
    """
    wanted = chosen(names, study_figures)
    target = folders[0] / "figures"
    target.mkdir(exist_ok=True)
    with style.rc_style(), Study.open(folders) as study:
        return draw_each(offered(study, wanted), target, formats, itertools.count(*share))


def offered(study: Study, names: Iterable[str]) -> Iterator[Drawing]:
    """Every picture of ``names`` that the data allow, each with the stem of its file."""
    for name in names:
        for suffix, make in study_figures[name](study.measuring(_MEASURE[name])):
            yield f"{name}-{suffix}" if suffix else name, make
