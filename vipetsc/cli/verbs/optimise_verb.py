"""The verb ``optimise``: the best clearances, sites, restitution or cell for an objective."""

from vipetsc.case.optimise import OptimiseCase
from vipetsc.cli.arguments import STUDY_ARGUMENTS, case_with
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.tables import first_few
from vipetsc.cli.verb import Rows, StudyVerb, study_of, summary
from vipetsc.io.kinds import OPTIMUM
from vipetsc.wording import counted


def optimise_rows(plan: OptimiseCase, ranks: int) -> Rows:
    """Return rows of ``validate``: number of designs, variables, frequency responses that are measured, objectives."""
    responses: Rows = []
    if plan.options.measures_responses:
        case = plan.responses(plan.base)
        low, high = case.nfrc.range
        curves = counted(len(case.every_curve()), "curve")
        responses = [("responses", f"{curves} of each design over the {case.nfrc.over}, {low:g} to {high:g}")]
    variables = first_few([variable.name for variable in plan.variables()])
    return [
        ("optimise", f"{plan.options.budget} designs of {variables}"),
        *responses,
        *(("objective", objective.describe(plan.amplitude_unit)) for objective in plan.options.objective),
        *(("constraint", constraint.describe(plan.amplitude_unit)) for constraint in plan.options.constraint or []),
    ]


VERB = StudyVerb(
    name="optimise",
    text="search for the best design for an objective",
    example="optimise runs/examples/optimise-clearances.toml --set optimise.budget=40",
    arguments=(case_with("optimise"), *STUDY_ARGUMENTS),
    case=OptimiseCase,
    study=study_of("vipetsc.studies.optimum_search:run_search", summary),
    table=optimise_rows,
    results=OPTIMUM,
    pictures=Pictures(OPTIMUM),
)
