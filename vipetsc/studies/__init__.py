"""Questions asked of runs: the analysis of one."""

from vipetsc.studies.analysis import analyse

__all__ = ["analyse"]
