"""Numbers as parts of file names: with few digits, but as many as different numbers need to differ."""

from collections.abc import Sequence

SHORT = 6  # digits of a number that differs from all others in them
EXACT = 17  # digits in which any two doubles differ


def distinct(numbers: Sequence[float]) -> list[str]:
    """A text for each of different ``numbers``, with six digits or as many as it takes that no two texts are equal.

    A number that differs from all others in six digits is written with six, also if others need more.
    """
    texts = [f"{number:.{SHORT}g}" for number in numbers]
    for digits in range(SHORT + 1, EXACT + 1):
        shared = {text for text in texts if texts.count(text) > 1}
        if not shared:
            break
        for i, number in enumerate(numbers):
            if texts[i] in shared:
                texts[i] = f"{number:.{digits}g}"
    return texts
