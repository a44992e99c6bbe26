"""The verb ``identify``: parameters of a case from measured records, with their uncertainty."""

from vipetsc.case.identify import IdentifyCase
from vipetsc.cli.arguments import STUDY_ARGUMENTS, case_with
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.tables import first_few
from vipetsc.cli.verb import Rows, StudyVerb, study_of, summary
from vipetsc.io.kinds import IDENTIFIED


def identify_rows(plan: IdentifyCase, ranks: int) -> Rows:
    """Return rows of ``validate``: the parameters and the number of starts, and each record with its sensors."""
    parameters = first_few([parameter.name for parameter in plan.parameters])
    rows = [("identify", f"{parameters}; starts: {plan.options.starts}")]
    for record in plan.options.records:
        sensors = first_few([sensor.name for sensor in record.sensors])
        begin = ""
        if record.initial == "estimate":
            begin = "; its initial state is estimated"
        rows.append(("record", f"{record.file}: {sensors}{begin}"))
    return rows


VERB = StudyVerb(
    name="identify",
    text="find parameters from measured records",
    example="identify runs/examples/identify.toml",
    arguments=(case_with("identify"), *STUDY_ARGUMENTS),
    case=IdentifyCase,
    study=study_of("vipetsc.studies.identification:run_identification", summary),
    table=identify_rows,
    results=IDENTIFIED,
    pictures=Pictures(IDENTIFIED),
)
