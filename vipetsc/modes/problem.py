"""Errors of the equations whose solutions form branches, shared by every method of finding them."""


class FlowError(RuntimeError):
    """The equations cannot be evaluated at these unknowns, as where a flow does not cover the requested time."""


class ContinuationError(RuntimeError):
    """The branch cannot go on; the message says where, why, and which option to turn."""


class StartError(ValueError):
    """There is no periodic orbit to begin a branch with; all ranks that seek one together find that out together."""
