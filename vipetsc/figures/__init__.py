"""Pictures, from files only; matplotlib is loaded when the first of these names is used."""

from importlib import import_module

_HOMES = {
    "bands": "vipetsc.figures.bands",
    "design_figures": "vipetsc.figures.design",
    "draw": "vipetsc.figures.registry",
    "draw_backbone": "vipetsc.figures.backbone",
    "draw_bands": "vipetsc.figures.registry",
    "draw_design": "vipetsc.figures.design",
    "draw_study": "vipetsc.figures.studies",
    "names": "vipetsc.figures.registry",
    "run_figures": "vipetsc.figures.registry",
    "save": "vipetsc.figures.registry",
    "rc_style": "vipetsc.figures.style",
    "study_figures": "vipetsc.figures.studies",
}

__all__ = [
    "bands",
    "design_figures",
    "draw",
    "draw_backbone",
    "draw_bands",
    "draw_design",
    "draw_study",
    "names",
    "rc_style",
    "run_figures",
    "save",
    "study_figures",
]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
