"""What is told of a lattice: waves of a damped cell, its ends, what a run begins with."""

from typing import Any

import numpy as np

from vipetsc.case import Case
from vipetsc.case.inhomogeneity import lobe_reflection
from vipetsc.case.warnings import losses
from vipetsc.lattice import UnitCell, max_group_velocity, pass_bands
from vipetsc.lattice.damped import absorber, damped_bloch, decay_length, reflection


def damping_table(cell: UnitCell, frequency: float) -> dict[str, Any]:
    """Damping ratio and decay time in s of each band's fastest wave; the decay length in cells at ``frequency``."""
    if not cell.is_damped:
        return {}
    rows = []
    for band in pass_bands(cell):
        kappa = max_group_velocity(cell, band.number)[0]
        point = damped_bloch(cell, kappa)
        rate = point.rate[band.number - 1]
        row = {"band": band.number, "wavenumber": kappa, "damping_ratio": float(point.ratio[band.number - 1])}
        rows.append(row | {"frequency": float(rate.imag), "decay_time": float(-1 / rate.real)})
    return {"damping": rows, "decay_length": {"frequency": frequency, "cells": decay_length(cell, frequency)}}


def damping_report(numbers: dict[str, Any]) -> str:
    """``damping_table`` as text; empty for a cell without dashpots."""
    if "damping" not in numbers:
        return ""
    lines = ["\nband  damping ratio  decays by 1/e in (s)   at: kappa/pi   rad/s"]
    for row in numbers["damping"]:
        lines.append(
            f"{row['band']:4d} {row['damping_ratio']:14.4g} {row['decay_time']:21.4g} "
            f"{row['wavenumber'] / np.pi:14.4f} {row['frequency']:8.2f}"
        )
    length = numbers["decay_length"]
    return "\n".join([*lines, f"at {length['frequency']:.6g} rad/s waves decay by 1/e in {length['cells']:.4g} cells"])


def ends_text(case: Case) -> str:
    """The ends; of one that absorbs, what comes back of the energy of a wave at each drive's frequency."""
    lattice, absorbing = case.lattice, case.lattice.absorbing
    if absorbing is None or not (absorbing.cells and absorbing.strength):
        return f"{lattice.ends} ends"
    end, told = absorber(lattice.unit_cell(), lattice.ends, absorbing.cells, absorbing.strength), []
    for omega, cycles in dict.fromkeys((one.frequency or 0.0, one.cycles) for _, one in case.drive.every):
        back, lobe = reflection(end, omega, absorbing.cells), lobe_reflection(end, omega, cycles)
        told.append(
            f"{back:.1e} of the energy comes back at {omega:.6g} rad/s, {lobe:.1e} of the burst's"
            if np.isfinite(lobe)
            else f"no wave comes to it at {omega:.6g} rad/s"
        )
    which = "both ends absorb" if absorbing.end == "both" else f"{lattice.ends} ends, the {absorbing.end} one absorbs"
    return f"{which} over {absorbing.cells} cells: {'; '.join(told)}"


def loss_text(case: Case) -> str:
    """The loss ratio of each band, least, mean and largest over its wavenumbers; empty where none is asked."""
    rows = enumerate(losses(case.lattice), 1)
    return "; ".join(
        f"band {band} {least:.3g}-{most:.3g}, mean {mean:.3g}" + f" (asked {asked:.3g})" * bool(np.isfinite(asked))
        for band, (asked, least, mean, most) in rows
    )


def initial_text(case: Case) -> str:
    """What a run begins with, in words; empty for a lattice at rest."""
    initial = case.initial
    if initial is None:
        return ""
    if initial.kind == "file":
        which = f" at {initial.time:g} s" if initial.time is not None else f", orbit {initial.orbit}"
        return f"{initial.path}{'' if initial.time is initial.orbit is None else which}"
    size = f"{initial.amplitude:.4g} m" if initial.amplitude else f"{initial.energy:.4g} J"
    if initial.kind == "mode":
        return f"mode {initial.number or f'near {initial.near:g} rad/s'}, {size}"
    return (
        f"a packet of band {initial.band} about kappa = {(initial.wavenumber or 0) / np.pi:.4f} pi,"
        f" {initial.width:g} cells wide in cell {initial.cell}, {size}"
    )
