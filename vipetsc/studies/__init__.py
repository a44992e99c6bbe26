"""Studies: measures of a run, and evaluations of many runs, in the frame of ``study``."""
