"""The command line, without numerics. The manual describes verbs and options.

``main`` has the parser and the exit codes, ``verb`` the record of a verb and the frame in which verbs that compute
results run, ``verbs/`` a module for each verb or family of verbs, and the list of all verbs. ``arguments`` are those
that several verbs accept. ``drawing`` draws the pictures of a folder. ``messages`` prints, also tables, and decides the
exit code if printing fails; ``case_rows`` makes rows of text. ``installation`` has the checks of the verb ``doctor``.
"""
