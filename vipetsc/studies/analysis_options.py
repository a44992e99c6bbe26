"""The options ``[analysis]`` of a run, and whether it was measured with them; loads no measure."""

import json
import tomllib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from vipetsc.case import Case
from vipetsc.case.reading import read_toml
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.netcdf import root_attributes
from vipetsc.io.read import RUN_NEEDS
from vipetsc.sources import source_key


def options_of(case: str, folder: Path | None = None, overrides: Iterable[str] = ()) -> AnalysisTable:
    """Return the options ``[analysis]`` of a ``case`` (TOML), or of that in ``folder``, with ``overrides``."""
    table = tomllib.loads(case)
    if folder and (folder / "case.toml").exists():
        # The user may have changed [analysis] there since the run.
        table = read_toml(folder / "case.toml")
    return Case.from_table(table, overrides).analysis or AnalysisTable.model_validate({})


def describe_options(options: AnalysisTable) -> str:
    """Return the ``options`` that results depend on, as text for the attribute ``analysis`` of a file."""
    return json.dumps(options.model_dump(exclude={"memory"}, exclude_none=True))


def is_measured(folder: Path) -> bool:
    """Return whether ``folder/analysis.h5`` is of this version and of ``run.h5`` as it is; raises as ``open_run``."""
    run = root_attributes(folder / "run.h5", "run", RUN_NEEDS)
    expected = {
        "case": run["case"],
        "status": run.get("status"),
        "source": source_key(),
        "analysis": describe_options(options_of(run["case"], folder)),
    }
    # One that is not there or was cut off raises OSError.
    with suppress(OSError):
        analysis = root_attributes(folder / "analysis.h5", "analysis")
        return all(analysis.get(key) == value for key, value in expected.items())
    return False
