"""What a fault leaves behind, at every phase of every verb: an exception, a full disk, a signal, a kill.

``phases`` reads the phases from the source, ``inject`` strikes at one of them, ``scenarios`` are tiny cases of every
verb, ``worker`` does trials with them under mpirun, ``trials`` starts it and judges, ``mutations`` spoils case files;
``campaign`` (``scripts/campaign``) does the whole matrix, random kills and random cases, with reports.
"""
