"""The command line; no numerics here. The manual describes verbs and options.

``main`` holds arguments and exit codes, ``verbs`` what each verb does, ``plot`` which pictures a folder gets,
``tables`` what is printed, ``doctor`` what an installation lacks.
"""
