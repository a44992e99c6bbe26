"""Kinds of results: for each the files of its folder, the one that is opened and drawn, and what messages call it.

Folders, readers, pictures and verbs take all of this from here.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ResultKind:
    """A kind of results, compared by its values, since ranks send copies; patterns of names are those of ``Path.glob``.

    Attributes
    ----------
    noun
        What messages call one result.
    file
        The file, or the pattern of the files, from which results are opened and pictures are drawn.
    records
        Patterns of the other files that show that a folder holds results of this kind.
    needs
        Variables that the one ``file`` of a study must hold for its pictures.
    name
        What pictures of such results are called in the registry of figures; by default the noun.
    has_folders
        Whether every folder in the folder belongs to the results, as those of a sweep's members do.
    marker
        Name of the file with the case of the results.
    free
        Section of the case that may change while the results stay valid; empty for none.
    grows
        Key of the case that ``--extend`` lets grow: the results go on from their end; empty for none.
    """

    noun: str
    file: str
    records: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    name: str = ""
    has_folders: bool = False
    marker: str = "case.toml"
    free: str = ""
    grows: str = ""

    @property
    def source(self) -> str:
        """The name by which pictures are asked for."""
        return self.name or self.noun

    @property
    def results(self) -> tuple[str, ...]:
        """Patterns of the files that show that a folder holds results of this kind."""
        return self.file, *self.records

    def is_in(self, folder: Path) -> bool:
        """Return whether ``folder`` holds results of this kind."""
        return any(any(folder.glob(pattern)) for pattern in self.results)


RUN = ResultKind("run", "run.h5", ("parts",), free="analysis", grows="time.end")
SWEEP = ResultKind("sweep", "ensemble.h5", ("members*.jsonl",), has_folders=True)
BRANCHES = ResultKind("branch", "branch-*.h5", name="branches")
SEARCH = ResultKind("search", "design.h5", needs=("cost", "frequency"), name="design")
LAW = ResultKind("law", "law.h5", ("law-runs*.jsonl",), needs=("share", "efficiency"))
PREDICTION = ResultKind(
    "prediction", "prediction.h5", ("prediction-runs*.jsonl",), needs=("predicted", "onset_amplitude")
)
OPTIMUM = ResultKind("optimum", "optimum.h5", ("optimum-runs*.jsonl",), needs=("value", "comparison"))
IDENTIFIED = ResultKind("identification", "identified.h5", ("identified-runs*.jsonl",), needs=("value", "profile"))
PAPER = ResultKind("paper", "plan.json", marker="plan.json")
KINDS = (RUN, BRANCHES, SEARCH, LAW, PREDICTION, SWEEP, OPTIMUM, IDENTIFIED, PAPER)
KIND_OF = {kind.source: kind for kind in KINDS}
# Studies whose pictures are drawn from one file alone.
STUDIES = tuple(kind for kind in KINDS if kind.needs)
