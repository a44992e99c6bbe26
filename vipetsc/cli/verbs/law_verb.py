"""The verb ``law``: the scattering law of one site."""

from vipetsc.case import LawCase
from vipetsc.cli.arguments import CASE, STUDY_ARGUMENTS
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.tables import table
from vipetsc.cli.verb import Rows, StudyVerb, study_of
from vipetsc.io.kinds import LAW


def law_rows(case: LawCase, ranks: int) -> Rows:
    """Return a row of ``validate`` with the range of the law, and the site, the ring and the samples of its runs."""
    site = case.one_site()
    where = f"a clearance of {site.clearance:.5g} m {site.distance} cells from the drive"
    return [("law", f"z to {case.law.largest:g}, {where}; ring of {site.cells} cells, {site.samples} samples")]


VERB = StudyVerb(
    name="law",
    text="compute the scattering law of one site with adaptive refinement",
    example="law runs/examples/law.toml --set law.tolerance=0.02",
    arguments=(CASE, *STUDY_ARGUMENTS),
    case=LawCase,
    study=study_of("vipetsc.studies.one_site:make_law", lambda law: table(law.summary())),
    table=law_rows,
    results=LAW,
    pictures=Pictures(LAW),
)
