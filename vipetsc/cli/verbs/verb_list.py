"""Verbs by their names: the records that the other modules of this folder declare."""

import pkgutil
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from vipetsc.case import CaseFile
from vipetsc.cli.verb import StudyVerb, Verb


def _declared() -> Iterator[Verb]:
    """Yield all verbs that the modules of this folder declare, module by module."""
    # Modules are found, not listed: a verb that is there cannot be missing from the help, completion or tests.
    for module in pkgutil.iter_modules([str(Path(__file__).parent)]):
        name = f"{__package__}.{module.name}"
        # This module declares no verb, and is still being imported itself.
        if name != __name__:
            values = vars(import_module(name)).values()
            yield from (value for value in values if isinstance(value, Verb))


VERBS: dict[str, Verb] = {verb.name: verb for verb in sorted(_declared(), key=lambda verb: verb.name)}


def study_verbs() -> list[StudyVerb]:
    """Return the verbs that compute results of a case."""
    return [verb for verb in VERBS.values() if isinstance(verb, StudyVerb)]


def verb_of(case: CaseFile) -> StudyVerb:
    """Return the verb that reads ``case``."""
    return next(verb for verb in study_verbs() if verb.case is type(case))
