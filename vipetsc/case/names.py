"""Names of files after numbers: short ones, and as many digits as tell different numbers apart."""

from collections.abc import Sequence

SHORT = 6  # digits of a name whose number no other one is near
EXACT = 17  # digits that tell all numbers apart


def distinct(numbers: Sequence[float]) -> list[str]:
    """A text for each of different ``numbers``: six digits, or as many as it takes that no two texts are equal.

    A number that six digits tell from all others has its six digits whatever the others are.
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
