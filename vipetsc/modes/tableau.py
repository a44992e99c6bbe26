"""The coefficients of DOP853, Dormand and Prince's explicit Runge-Kutta method of order 8 with its two error estimates.

Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, 2nd ed. 1993, sec. II.5 and II.10, and the
authors' code DOP853. Stage s is y + h sum_r A[s, r] k_r, the new state y + h sum_r B[r] k_r; E5 and E3 give the
estimates of orders 5 and 3, which II.10 combines into err5^2 / sqrt(err5^2 + err3^2 / 100).
"""

import numpy as np

STAGES = 12

# fmt: off
# Row s = 1, ..., 11: A[s, 0], then the last of A[s, 1], ..., A[s, s - 1]; those between are zero.
_ROWS = (
    (0.05260015195876773,),
    (0.0197250569845379, 0.0591751709536137),
    (0.02958758547680685, 0.08876275643042054),
    (0.2413651341592667, -0.8845494793282861, 0.924834003261792),
    (0.037037037037037035, 0.17082860872947386, 0.12546768756682242),
    (0.037109375, 0.17025221101954405, 0.06021653898045596, -0.017578125),
    (0.03709200011850479, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402, 0.008273789163814023),
    (0.6241109587160757, -3.3608926294469414, -0.868219346841726, 27.59209969944671, 20.154067550477894,
     -43.48988418106996),
    (0.47766253643826434, -2.4881146199716677, -0.590290826836843, 21.230051448181193, 15.279233632882423,
     -33.28821096898486, -0.020331201708508627),
    (-0.9371424300859873, 5.186372428844064, 1.0914373489967295, -8.149787010746927, -18.52006565999696,
     22.739487099350505, 2.4936055526796523, -3.0467644718982196),
    (2.273310147516538, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
     -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
)
# Stages 0 and 5, ..., 11; the others are zero.
_WEIGHTS = (0.054293734116568765, 4.450312892752409, 1.8915178993145003, -5.801203960010585, 0.3111643669578199,
            -0.1521609496625161, 0.20136540080403034, 0.04471061572777259)
_ERROR_5 = (0.01312004499419488, -1.2251564463762044, -0.4957589496572502, 1.6643771824549864, -0.35032884874997366,
            0.3341791187130175, 0.08192320648511571, -0.022355307863886294)
# The weights of the third-order method, of stages 0, 8 and 11.
_THIRD = ((0, 0.2440944881889764), (8, 0.7338466882816118), (11, 0.022058823529411766))
# fmt: on


def _spread(first: float, *last: float, size: int) -> np.ndarray:
    """A row (size,) with its first and its last entries; those between are zero."""
    return np.array([first, *[0.0] * (size - 1 - len(last)), *last])


A = np.zeros((STAGES, STAGES))
for _stage, _row in enumerate(_ROWS, 1):
    A[_stage, :_stage] = _spread(*_row, size=_stage)
B = _spread(*_WEIGHTS, size=STAGES)
E5 = _spread(*_ERROR_5, size=STAGES)
E3 = B.copy()
for _stage, _weight in _THIRD:
    E3[_stage] -= _weight
