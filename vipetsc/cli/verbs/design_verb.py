"""The verb ``design``: repeat the paper's (lambda, eta) search for the four-band cell."""

from vipetsc.case import DesignCase
from vipetsc.cli.arguments import CASE, STUDY_ARGUMENTS
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.verb import Rows, StudyVerb, study_of, summary
from vipetsc.io.kinds import SEARCH


def design_rows(case: DesignCase, ranks: int) -> Rows:
    """Return a row of ``validate`` with the size of the grid, and the readings in which it is searched."""
    search = case.design
    cells = f"{len(search.lam.values())} lambda x {len(search.eta.values())} eta"
    return [("design", f"{cells}, {search.wavenumbers} wavenumbers, {' and '.join(search.readings)}")]


VERB = StudyVerb(
    name="design",
    text="repeat the paper's (lambda, eta) search for the four-band cell",
    example="design runs/examples/design.toml --set design.lambda.count=10",
    arguments=(CASE, *STUDY_ARGUMENTS),
    case=DesignCase,
    study=study_of("vipetsc.paper.cell_search:search_design", summary),
    table=design_rows,
    results=SEARCH,
    pictures=Pictures(SEARCH),
    is_stoppable=False,  # it takes seconds, and has nothing to save before its end
)
