"""The command line; no numerics here. The manual describes verbs and options.

``main`` holds the parser and exit codes, ``verb`` the record of a verb and the frame in which those that compute
results run, ``verbs/`` a module for each verb or family, and a list of all; ``arguments`` what several verbs take,
``drawing`` the pictures of a folder, ``messages`` what is printed where, ``streams`` the exit code where printing
fails, ``tables`` and ``case_rows`` rows of text.
"""
