"""The loading of matplotlib by programs that only draw."""


def load_matplotlib() -> None:
    """Load matplotlib without the lists of properties in the help texts of its classes, a third of its loading.

    Where it is loaded already, nothing changes.
    """
    from matplotlib import artist

    compose = artist.kwdoc
    # Called for each class of artists when it is defined.
    artist.kwdoc = lambda kind: ""
    try:
        import matplotlib.figure  # noqa: F401
    finally:
        artist.kwdoc = compose
