"""The verbs: a module declares the record of one, or of a few that belong together, and holds what it does.

A module here is a verb of the program: ``verb_list`` finds it. What a verb alone needs is imported inside
its functions, since compiled kernels and matplotlib take seconds to load.
"""
