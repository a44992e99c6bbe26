# What type checkers and editors read: the module itself loads these names when they are first used.
from vipetsc import register as register
from vipetsc.case import Case as Case
from vipetsc.case import CaseError as CaseError
from vipetsc.case import Sweep as Sweep
from vipetsc.io.impacts import impacts as impacts
from vipetsc.io.read import open_results as open
from vipetsc.modes.user_equations import follow as follow
from vipetsc.parallel import install_abort_hook as install_abort_hook
from vipetsc.studies.analysis import analyse as analyse
from vipetsc.studies.pictures import plot as plot
from vipetsc.studies.simulation import simulate as simulate
from vipetsc.studies.sweep import run_sweep as sweep

__version__: str
__all__ = [
    "Case",
    "CaseError",
    "Sweep",
    "analyse",
    "follow",
    "impacts",
    "install_abort_hook",
    "open",
    "plot",
    "register",
    "simulate",
    "sweep",
]
