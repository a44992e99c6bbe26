"""Pages that only the paper has: sweeps in its panels. Of any sweep the registry has pages of what it measured."""

from types import MappingProxyType

from vipetsc.figures import transfer, transfer_curves
from vipetsc.figures.registry import FigureSpec
from vipetsc.io.kinds import SWEEP
from vipetsc.paper import entropy_pages

_SPECS = (
    FigureSpec("entropy", SWEEP, entropy_pages.entropy, measure="entropy"),
    FigureSpec("entropy_all", SWEEP, entropy_pages.entropy_all, measure="entropy"),
    FigureSpec("entropy_history", SWEEP, entropy_pages.entropy_history, measure="entropy"),
    FigureSpec("band_energies-shares", SWEEP, transfer.band_shares, measure="transfer"),
    FigureSpec("ibtet", SWEEP, transfer_curves.ibtet, measure="transfer"),
)
PAGES = MappingProxyType({spec.name: spec for spec in _SPECS})
