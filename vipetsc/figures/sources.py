"""The sources of pictures: what folders hold, and the one file that pictures are drawn from where it is one."""

from collections.abc import Mapping
from typing import NamedTuple

RUN = "run"
SWEEP = "sweep"
BRANCHES = "branches"
DESIGN = "design"
OPTIMUM = "optimum"
IDENTIFIED = "identification"
LAW = "law"
PREDICTION = "prediction"
PAPER = "paper"  # sweeps of the paper, in its panels; of any sweep `measure_pages` draws what it measured


class ResultFile(NamedTuple):
    """The one file that a source is drawn from: its ``name`` in the folder, and variables that it must hold."""

    name: str
    needs: tuple[str, ...]


FILES: Mapping[str, ResultFile] = {
    DESIGN: ResultFile("design.h5", needs=("cost", "frequency")),
    OPTIMUM: ResultFile("optimum.h5", needs=("value", "comparison")),
    IDENTIFIED: ResultFile("identified.h5", needs=("value", "profile")),
    LAW: ResultFile("law.h5", needs=("share", "efficiency")),
    PREDICTION: ResultFile("prediction.h5", needs=("predicted", "onset_amplitude")),
}
