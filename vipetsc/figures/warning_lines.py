"""The lines below a picture: warnings in the results that it shows, each with the names of the members that have it."""

import json
import re
from collections.abc import Callable, Sequence

from matplotlib.figure import Figure

from vipetsc.figures.style import Shown
from vipetsc.wording import counted

NUMBER = re.compile(r"\d[\d.e+-]*")
MOST_WARNINGS = 4  # below a picture: the strip must not be higher than the panels
MOST_NAMES = 4  # of members before a warning; of more their number is given


def warned(make: Callable[[], Figure], shown: Sequence[Shown], without: Sequence[str] = ()) -> Callable[[], Figure]:
    """Return a function like ``make`` whose figure has the warnings of the results ``shown`` as lines of its label.

    Those that contain one of the words ``without`` are left out.

    Results have them as JSON in the attribute ``warnings``; `vipetsc.figures.style.save` prints the label below the
    picture.
    """
    lines = warning_lines(shown, without)

    def labelled() -> Figure:
        figure = make()
        # A figure may have notes of its own, as on what it leaves out.
        notes = filter(None, figure.get_label().splitlines())
        figure.set_label("\n".join([*notes, *lines]))
        return figure

    return labelled


def warning_lines(shown: Sequence[Shown], without: Sequence[str] = ()) -> list[str]:
    """Return the warnings of the results ``shown``, each once; if several names are shown, with those of its members.

    Of sentences that differ only in numbers the first is given; those with a word of ``without`` are left out.
    """
    by_kind: dict[str, list[str]] = {}
    names: dict[str, list[str]] = {}
    for member in shown:
        for sentence in _warnings(member):
            if any(word in sentence for word in without):
                continue
            kind = NUMBER.sub("0", sentence)
            by_kind.setdefault(kind, []).append(sentence)
            names.setdefault(kind, []).append(member.name)

    lines = [sentences[0] for sentences in by_kind.values()]
    if len({member.name for member in shown}) > 1:
        lines = [f"{_listed(names[kind], by_kind[kind])}: {by_kind[kind][0]}" for kind in by_kind]
    if len(lines) > MOST_WARNINGS:
        lines[MOST_WARNINGS - 1 :] = [f"{len(lines) - MOST_WARNINGS + 1} more warnings are in the file"]
    return lines


def _warnings(member: Shown) -> list[str]:
    """Return the sentences of the results of a member, each once."""
    attributes = [result.attrs.get("warnings", "[]") for result in member.results]
    return list(dict.fromkeys(sentence for text in attributes for sentence in json.loads(text)))


def _listed(names: Sequence[str], sentences: Sequence[str]) -> str:
    """Return the text before a warning: the ``names`` of the members that have one of its ``sentences``, each once."""
    distinct = list(dict.fromkeys(names))
    text = ", ".join(distinct[:MOST_NAMES])
    if len(distinct) > MOST_NAMES:
        text += f" and {counted(len(distinct) - MOST_NAMES, 'other')}"
    if len(set(sentences)) > 1:
        text += f" (numbers of {distinct[0]})"
    return text
