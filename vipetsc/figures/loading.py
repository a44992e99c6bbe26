"""The loading of matplotlib by programs that only draw."""


def load_matplotlib() -> None:
    """Load matplotlib without the lists of properties in the docstrings of its classes, a third of its loading time.

    Nothing changes if it is loaded already.
    """
    from matplotlib import artist

    compose = artist.kwdoc
    # Matplotlib calls the function for each class of artists when it defines the class.
    artist.kwdoc = lambda kind: ""
    try:
        import matplotlib.figure  # noqa: F401
    finally:
        artist.kwdoc = compose
