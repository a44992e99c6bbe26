"""Tests of faults at every phase of every verb: an exception, no memory, a full disk, a signal, a kill.

``phases`` reads the names of the phases from the source, ``inject`` causes a fault at one of them, ``scenarios`` has
tiny cases of every verb. ``worker`` runs trials with these cases under mpirun; ``trials`` lists the trials, starts the
worker and judges the outcomes. ``mutations`` damages case files at random. ``campaign`` (``scripts/campaign``) runs all
trials, random kills and random case files, and reports on them.
"""
