"""The verbs: each module declares the record of one verb, or of a few related ones, and implements it.

``verb_list`` collects the verbs of all modules. Modules that only one verb needs are imported inside its functions,
because compiled kernels and matplotlib take seconds to load.
"""
