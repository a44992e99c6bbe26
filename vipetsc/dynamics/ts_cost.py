"""Cost of a step of ``ts``, as fitted to the paper's lattices on one core."""

# Seconds of an accepted step of 8vr, and of a mass in it; radians of the top band in a step.
STEP = 3.7e-5
MASS = 1.3e-7
RESOLVED = 0.37


def step_seconds(masses: float) -> float:
    """CPU time in s of a step in which so many ``masses`` move."""
    return STEP + MASS * masses
