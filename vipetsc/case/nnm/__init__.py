"""What belongs to the verb ``nnm`` alone: ``case``, its section (``table``), and problems between keys (``checks``)."""

from vipetsc.case.nnm.case import NnmCase
from vipetsc.case.nnm.table import MOST_OF_DAMPED, Guards, NnmTable
