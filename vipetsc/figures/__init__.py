"""Pictures, from files only; matplotlib is loaded when the first of these names is used."""

from importlib import import_module

_HOMES = {
    "bands": "vipetsc.figures.bands",
    "draw": "vipetsc.figures.registry",
    "draw_backbone": "vipetsc.figures.backbone",
    "draw_bands": "vipetsc.figures.registry",
    "draw_design": "vipetsc.figures.design",
    "design_figures": "vipetsc.figures.design",
    "names": "vipetsc.figures.registry",
    "run_figures": "vipetsc.figures.registry",
    "save": "vipetsc.figures.registry",
    "look": "vipetsc.figures.style",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
