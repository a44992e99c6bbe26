"""A lattice as a strip of cells with its ends, its drive and its contact sites."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from vipetsc.case.contacts import has_equal_sides
from vipetsc.figures import style
from vipetsc.lattice import Chain


def draw_lattice(axes: Axes, chain: Chain, drive_cell: float) -> None:
    """Draw the lattice as a strip: its ends, drive and contacts with their cells and clearances.

    ``drive_cell`` is 0-based, and lies beyond the last cell where a wall moves. Cells have a width of 1 on the axis,
    and the strip a height of 1.
    """
    n = chain.cells
    axes.add_patch(Rectangle((0.5, 0), n, 1, fc="#EEEEEE", ec=style.BLACK, lw=0.6))
    # Borders of more cells would merge.
    if n <= 150:
        axes.vlines(np.arange(1, n) + 0.5, 0, 1, color="white", lw=0.5)
    if chain.ends == "fixed":
        for wall in (0.5 - 0.02 * n, n + 0.5):
            draw_wall(axes, (wall, -0.25), 0.02 * n, 1.5)
        axes.vlines([0.5, n + 0.5], -0.25, 1.25, color=style.BLACK, lw=1.0)

    # The arrow of the drive ends on the strip, or above the number of a site in the driven cell or next to it.
    near = min((abs(site.cell - drive_cell) for site in chain.sites), default=n)
    tip = 1.8 if near < 0.03 * n else 1.0
    arrow = {"arrowstyle": "-|>", "color": style.BLUE, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (drive_cell + 1, tip), (drive_cell + 1 + 0.02 * n, tip + 0.7), arrowprops=arrow)

    if chain.sites:
        _draw_sites(axes, chain)
    else:
        axes.text(n / 2, -0.2, "no contact sites", color=style.GREY, ha="center", va="top")
    axes.set(xlim=(0.5 - 0.035 * n, 0.5 + 1.035 * n), ylim=(-1.2, 2.6))
    axes.set_axis_off()


def _draw_sites(axes: Axes, chain: Chain) -> None:
    """Draw a mark for every site, with its cell above and its clearance in mm below where there is room."""
    n = chain.cells
    width = min(max(0.006 * n, 1), 0.02 * n)
    gaps = chain.sites.gaps
    if has_equal_sides(gaps):
        texts = [f"{1e3 * gap:#.3g}" for gap, _ in gaps]
    else:
        texts = [_gap_label(plus, minus) for plus, minus in gaps]
    # From the left to the right, so that the first of a group of sites has the label.
    last_labelled = -np.inf
    for site, text in sorted(zip(chain.sites.cells.tolist(), texts, strict=True)):
        axes.add_patch(Rectangle((site + 1 - width / 2, 0), width, 1, fc=style.VERMILION, lw=0))

        # A label takes about a twentieth of the strip: sites next to one with a label have none.
        if site - last_labelled > 0.06 * n:
            axes.text(site + 1, 1.2, f"{site + 1}", ha="center", va="bottom", fontsize=7)
            below = {"color": style.VERMILION, "ha": "center", "va": "top", "linespacing": 1.0}
            axes.text(site + 1, -0.2, text, **below)
            last_labelled = site


def _gap_label(plus: float, minus: float) -> str:
    """Return the clearances in mm of a site's stops by their side, a line each; a stop that touches is 0."""
    lines = []
    for side, gap in (("+", plus), ("-", minus)):
        if np.isfinite(gap):
            # "+ 0.5": the stop on the side +, 0.5 mm away. The clearance of a pressed stop is negative: "+ -0.5".
            lines.append(f"{side} {1e3 * gap:.4g}" if gap else "0")
    return "\n".join(lines)


def draw_wall(axes: Axes, corner: tuple[float, float], width: float, height: float) -> None:
    """Draw a hatched wall from its lower left ``corner`` on."""
    axes.add_patch(Rectangle(corner, width, height, fc="white", ec=style.GREY, hatch="//////", lw=0.0))
