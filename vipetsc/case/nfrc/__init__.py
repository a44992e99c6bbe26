"""What belongs to the verb ``nfrc`` alone.

``case`` has its case, ``table`` its section. A curve may run over a key of the case (``varied_key``), and a family has
curves with several values of keys (``family``). ``measures`` names the measures of a whole curve, by which ``optimise``
judges a design.
"""

from vipetsc.case.nfrc.case import MOST_UNKNOWNS, NfrcCase, ResponseCurve, needs_modes
from vipetsc.case.nfrc.measures import FRACTIONS, RESPONSE, WALLS, ResponseMeasure, value_of
from vipetsc.case.nfrc.table import NfrcTable
