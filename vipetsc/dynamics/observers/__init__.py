"""What watches a run, sample by sample, without changing it; the contract is in ``base``.

``guard`` ends a run whose state is no solution any more, ``ledger`` keeps the error of the energy balance, ``recorder``
keeps what is written, ``progress`` tells how far it is. A further observer is a subclass of ``Observer`` with a name.
"""

from vipetsc.dynamics.observers.base import Observer, RunawayError, Sample, Setup
from vipetsc.dynamics.observers.guard import Guard
from vipetsc.dynamics.observers.ledger import Ledger
from vipetsc.dynamics.observers.progress import ProgressReport
from vipetsc.dynamics.observers.recorder import Recorder
