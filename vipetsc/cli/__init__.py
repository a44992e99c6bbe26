"""The command line, without numerics. The manual describes verbs and options.

``main`` contains the parser and the exit codes; ``verb`` the record of a verb and the frame in which verbs that compute
results run; ``verbs/`` a module for each verb or family of verbs, and the list of all verbs; ``arguments`` the common
arguments; ``drawing`` the pictures of a folder; ``messages`` the output of messages; ``streams`` the exit code if
printing fails; ``tables`` and ``case_rows`` rows of text.
"""
