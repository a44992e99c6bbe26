"""The verbs: each module declares the records of one verb, or of a few related ones, and implements them.

``verb_list`` collects the verbs of all modules. What only one verb needs is imported inside its functions, because
compiled kernels and matplotlib take seconds to load.
"""
