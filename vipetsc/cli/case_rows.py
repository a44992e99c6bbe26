"""Description of a case as text: the lattice with its ends, bands and losses, and the contacts with their sites."""

import numpy as np

from vipetsc.case import Case
from vipetsc.case.absorbing import reflected, reflected_at, sections_of, sources_of
from vipetsc.case.contacts import describe_stops
from vipetsc.case.warnings import losses
from vipetsc.cli.messages import first_few
from vipetsc.lattice import gaps, wave_bands
from vipetsc.wording import MOST_SHOWN, counted


def lattice_rows(case: Case) -> list[tuple[str, str]]:
    """Return rows of a table, name and text, that describe the lattice, the bands and the contacts of a case."""
    model = case.model()
    chain = model.chain
    cell = chain.cell

    lattice = f"{counted(chain.cells, 'cell')}, {counted(chain.cells * cell.dofs, 'mass')}, {describe_ends(case)}"
    if case.lattice.preset:
        lattice += f", reading {case.lattice.reading}"
    strip = case.lattice.section_of_strip
    if strip:
        lattice += f"; strip of {chain.cells} x {strip.rows} cells, {strip.kind}, {strip.edges} edges, {strip.motion}"
    band_list = "none: no spring runs from cell to cell"
    gap_list = ""
    bands = wave_bands(cell)
    if bands:
        band_list = first_few([f"{band.low:.2f}-{band.high:.2f}" for band in bands]) + " rad/s"
        gap_list = "none"
        if between := gaps(bands):
            gap_list = ", ".join(f"{low:.2f}-{high:.2f}" for low, high in between) + " rad/s"
    # Each of a million sites may have its own law: a list shows only the first ones.
    laws = chain.sites.laws[:MOST_SHOWN]
    clearances = describe_stops(chain.sites.gaps)
    sites: list[object] = (chain.sites.cells + 1).tolist()
    if strip:
        sites = [strip.place(site.cell + 1, site.pair.resonator + 1) for site in chain.sites]

    return [
        ("case", case.name),
        ("lattice", lattice),
        ("pass bands", band_list),
        ("gaps", gap_list),
        ("loss", describe_losses(case)),
        ("contact", "; ".join(dict.fromkeys(map(str, laws))) or "none"),
        ("sites", first_few(sites)),
        ("clearance", first_few(clearances)),
    ]


def describe_ends(case: Case) -> str:
    """Return the description of the ends; for absorbing ones with the fractions of the energy that they reflect.

    For each drive these are the fraction at its frequency, and that of all waves that it sends.
    """
    lattice = case.lattice
    absorbing = lattice.absorbing
    if absorbing is None or not (absorbing.cells and absorbing.strength):
        return f"{lattice.ends} ends"

    cell = lattice.unit_cell()
    sections = sections_of(absorbing, cell, lattice.ends, absorbing.cells, absorbing.strength)
    reflections = []
    for source in sources_of(case.model().drives, cell, lattice.ends, lattice.cells):
        omega = source.waveform.frequency
        back = reflected_at(omega, sections)
        everything = f"{reflected([source], sections):.1e} of all waves that the drive sends"
        if np.isfinite(back):
            reflections.append(f"it reflects {back:.1e} of the energy at {omega:.6g} rad/s, {everything}")
        else:
            reflections.append(f"no wave reaches it at {omega:.6g} rad/s; it reflects {everything}")

    ends = "both ends absorbing"
    if absorbing.end != "both":
        ends = f"{lattice.ends} ends, the {absorbing.end} one absorbing"
    return f"{ends} over {absorbing.cells} cells: {'; '.join(dict.fromkeys(reflections))}"


def describe_losses(case: Case) -> str:
    """Return least, largest and mean loss of each band over its wavenumbers, as text; empty if no loss is prescribed.

    The loss is twice the damping ratio. If the case requests a loss of the band, it follows in brackets.
    """
    sentences = []
    for band, (requested, least, mean, most) in enumerate(losses(case.lattice), 1):
        sentence = f"band {band} {least:.3g}-{most:.3g}, mean {mean:.3g}"
        if np.isfinite(requested):
            sentence += f" (requested {requested:.3g})"
        sentences.append(sentence)
    return "; ".join(sentences)
