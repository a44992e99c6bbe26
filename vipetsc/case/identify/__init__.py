"""What belongs to the verb ``identify`` alone.

``case`` has its case and section; ``measured`` reads records of measured motion; ``sought`` has the parameters that are
sought, and ``trial`` the cases with trial values of them.
"""

from vipetsc.case.identify.case import IdentifyCase
from vipetsc.case.identify.measured import (
    SENSOR_UNITS,
    Measured,
    MeasuredError,
    RecordTable,
    SensorTable,
    read_measured,
)
from vipetsc.case.identify.sought import SoughtParameter, UnknownTable, parameters_of, values_of
from vipetsc.case.identify.trial import TrialCases
