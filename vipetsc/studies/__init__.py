"""Studies: measures of a run, and evaluations of many runs."""
