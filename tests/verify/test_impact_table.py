"""The table of impacts: impulses by the balance of momentum, transfers by band, names of parts, what is exported."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import vipetsc
from tests.verify.test_rigid_impacts import row
from vipetsc import Case, simulate

# A mass between soft springs, which meets a stop at its largest speed.
MASS = 2e-3
SPEED = 0.3


def struck(engine: str, law: str, restitution: float) -> Case:
    """Return a mass that flies at ``SPEED`` onto a stop of the ground, whose force is far larger than the springs'."""
    stiffness = {"hertz": 1e9, "bilinear": 1e6}[law]
    springs = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}]
    contacts = {"law": law, "stiffness": stiffness, "restitution": restitution, "damping": "exact", "clearance": 0.0}
    return Case(
        lattice={"cells": 1, "cell": {"masses": [MASS], "springs": springs}},
        contacts=contacts | {"sites": [1], "pair": [0, 1], "side": "plus"},
        initial={"kind": "velocity", "cell": 1, "velocity": SPEED},
        time={"end": 2e-3, "sample_interval": 5e-5, "engine": engine},
    )


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize(("law", "restitution"), [("hertz", 1.0), ("hertz", 0.6), ("bilinear", 0.8)])
def test_the_impulse_of_an_impact_is_the_change_of_momentum(engine, law, restitution):
    """A mass that comes with v and leaves with -r v has got m (1 + r) v, less what its springs gave it meanwhile."""
    result = simulate(struck(engine, law, restitution))
    (impact,) = vipetsc.impacts(result).itertuples()
    pd.testing.assert_frame_equal(vipetsc.impacts(result), vipetsc.impacts(result.dataset))
    assert impact.impulse == pytest.approx(MASS * (1 + restitution) * SPEED, rel=1e-5)
    assert impact.loss == pytest.approx(MASS * SPEED**2 * (1 - restitution**2) / 2, rel=1e-5, abs=1e-12)
    assert (impact.cell, impact.side) == (1, 1)


@pytest.mark.parametrize("law", ["hertz", "bilinear", "rigid"])
@pytest.mark.parametrize("clearance", [0.01, 0.03])
def test_an_onset_at_the_border_of_two_steps_is_an_impact(law, clearance):
    """The log has the full approach velocity of a mass that comes to its stop where a step of the engine ends."""
    stiffness = {"law": law}
    if law != "rigid":
        stiffness["stiffness"] = 1e6
    run = simulate(row(8, 0.5, "propagator", contacts={"clearance": clearance, "sites": [1]} | stiffness))
    # The mass moves at 1 m/s.
    steps = clearance / run.statistics["interval"]
    assert steps == pytest.approx(round(steps), rel=1e-12)
    log = vipetsc.impacts(run)
    np.testing.assert_allclose(log["onset"], clearance, rtol=1e-12)
    np.testing.assert_allclose(log["approach_velocity"], -1.0, rtol=1e-12)


def test_impulses_of_both_engines_agree_in_a_lattice():
    """Impulses of both engines agree within 1e-5 of the largest, also where impacts of two sites overlap."""
    impulses = []
    for engine in ("ts", "propagator"):
        time = {"end": 0.05, "engine": engine}
        case = Case(
            lattice={"cells": 30}, contacts={"sites": [6, 7]}, drive={"amplitude": 60.0, "cycles": 4}, time=time
        )
        impulses.append(vipetsc.impacts(simulate(case).dataset)["impulse"].values)
    first, second = impulses
    assert len(first) == len(second) > 5
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-5 * first.max())


def test_a_table_of_impacts_has_what_each_moved_between_bands(in_process, tmp_path):
    """Each impact has its cluster; one alone in it has the cluster's transfers, which ``export`` writes with units."""
    case = Case(lattice={"cells": 30}, contacts={"sites": [6, 7]}, drive={"amplitude": 60.0, "cycles": 4})
    simulate(case, tmp_path / "run")
    assert in_process("analyse", tmp_path / "run").returncode == 0
    table = vipetsc.impacts(tmp_path / "run")

    with vipetsc.open(tmp_path / "run" / "analysis.h5") as analysis:
        names = analysis["bands/part"].values.tolist()
        assert "band 2" in names
        alone = table.groupby("cluster").filter(lambda rows: len(rows) == 1)
        assert len(alone) > 0
        for part in names:
            moved = analysis["bands/transfer"].sel({"bands/part": part}).values
            assert alone[f"transfer to {part}"].tolist() == moved[alone["cluster"] - 1].tolist()
    crowded = table.index.difference(alone.index)
    assert len(crowded) > 1
    assert table.loc[crowded, "transfer to band 2"].isna().all()

    assert in_process("export", tmp_path / "run").returncode == 0
    written = pd.read_csv(tmp_path / "run/curves/run-impacts.csv", float_precision="round_trip")
    assert written["impulse (N s)"].tolist() == table["impulse"].tolist()
    assert written["transfer to band 2 (J)"].dropna().tolist() == table["transfer to band 2"].dropna().tolist()
    assert written["cell"].tolist() == table["cell"].tolist()
