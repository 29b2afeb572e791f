"""Linear Whipple bicycle, upright and straight (B16). Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A
463 (2007) 1955.

M q'' + v C1 q' + (g K0 + v^2 K2) q = f, q = (roll, steer). Axes of the paper: x forward, y right, z down,
origin at the rear contact; roll > 0 to the right, steer > 0 to the right. R, B, H, F: rear wheel, rear body,
front handlebar, front wheel. x, z of the wheels' centres are (0, -r_R) and (w, -r_F). Inertias are central,
in these axes; I_zz of a wheel equals its I_xx. `matrices` is the appendix of the paper, from 25 parameters;
the constants below are its values to 21 digits.
"""

import numpy as np

BENCHMARK = {
    "w": 1.02, "c": 0.08, "lam": np.pi / 10, "g": 9.81,
    "rR": 0.3, "mR": 2.0, "IRxx": 0.0603, "IRyy": 0.12,
    "xB": 0.3, "zB": -0.9, "mB": 85.0, "IBxx": 9.2, "IByy": 11.0, "IBzz": 2.8, "IBxz": 2.4,
    "xH": 0.9, "zH": -0.7, "mH": 4.0,
    "IHxx": 0.05892, "IHyy": 0.06, "IHzz": 0.00708, "IHxz": -0.00756,
    "rF": 0.35, "mF": 3.0, "IFxx": 0.1405, "IFyy": 0.28,
}  # fmt: skip

M = np.array([[80.81722, 2.319413322087091347748], [2.319413322087091347748, 0.2978418819968555299862]])
C1 = np.array([[0, 33.86641391492494388276], [-0.8503564145697843703629, 1.685403973975596741057]])
K0 = np.array([[-80.95, -2.599516852498716407343], [-2.599516852498716407343, -0.8032948845861768808105]])
K2 = np.array([[0, 76.59734589573222151899], [0, 2.654315237946040252254]])

# speed: castering, capsize (both real), weave real part, weave imaginary part; at v = 0 the weave pair is two
# real roots.
_MODES = {
    1: (-7.11008014637440773, -3.13423125066578423, 3.52696170990069417, 0.807740275199310045),
    2: (-8.67387984831737163, -3.07158645641514251, 2.68234517512745345, 1.68066296590675776),
    3: (-10.3510146724592282, -2.63366137253665296, 1.70675605663973515, 2.31582447384324357),
    4: (-12.1586142657644397, -1.42944427361325745, 0.413253315211241321, 3.07910818603205363),
    5: (-14.0783896927982472, -0.322866429004087078, -0.775341882195841925, 4.46486771378822514),
    6: (-16.085371230980284, -0.00406690076970336242, -1.52644486584141715, 5.87673060598708403),
    7: (-18.1578846612520209, 0.102681705747664159, -2.13875644258363428, 7.19525913329804255),
    8: (-20.279408943945663, 0.143278797657129498, -2.69348683581094772, 8.4603797139693359),
    9: (-22.4378855904085906, 0.157901840309172982, -3.21675402252490747, 9.69377351531782195),
    10: (-24.6245963501740002, 0.161053386531715542, -3.72016840437287573, 10.906811394762882),
}
# speed -> the four eigenvalues: castering, capsize, weave pair
EIGENVALUES: dict[int, np.ndarray] = {
    0: np.array(
        [-5.53094371765393464, -3.13164324790655567, 3.13164324790655567, 5.53094371765393464], complex
    ),
    **{v: np.array([ca, cs, complex(re, im), complex(re, -im)]) for v, (ca, cs, re, im) in _MODES.items()},
}
WEAVE_SPEED = 4.2923825363411039587
CAPSIZE_SPEED = 6.0242620153883588899
DOUBLE_ROOT_SPEED = 0.68428307889246
WHEEL_LOADS = {"rear": 612.836470588236, "front": 309.303529411765}  # N, at rest


def matrices(p: dict, cos=np.cos, sin=np.sin) -> dict[str, list]:
    """M, C1, K0, K2 as nested lists of the entries, from the 25 parameters (appendix A of the paper).

    Entries are whatever the parameters are: floats, arrays (one bicycle per element) or, with cos and sin of
    JAX, values that it traces.
    """
    w, c, lam, r_r, r_f = p["w"], p["c"], p["lam"], p["rR"], p["rF"]
    m_r, m_b, m_h, m_f = p["mR"], p["mB"], p["mH"], p["mF"]
    x_b, z_b, x_h, z_h = p["xB"], p["zB"], p["xH"], p["zH"]
    cl, sl = cos(lam), sin(lam)
    # the whole (T)
    m_t = m_r + m_b + m_h + m_f
    x_t = (x_b * m_b + x_h * m_h + w * m_f) / m_t
    z_t = (-r_r * m_r + z_b * m_b + z_h * m_h - r_f * m_f) / m_t
    t_xx = (
        p["IRxx"]
        + p["IBxx"]
        + p["IHxx"]
        + p["IFxx"]
        + m_r * r_r**2
        + m_b * z_b**2
        + m_h * z_h**2
        + m_f * r_f**2
    )
    t_xz = p["IBxz"] + p["IHxz"] - m_b * x_b * z_b - m_h * x_h * z_h + m_f * w * r_f
    t_zz = p["IRxx"] + p["IBzz"] + p["IHzz"] + p["IFxx"] + m_b * x_b**2 + m_h * x_h**2 + m_f * w**2
    # the front assembly (A)
    m_a = m_h + m_f
    x_a = (x_h * m_h + w * m_f) / m_a
    z_a = (z_h * m_h - r_f * m_f) / m_a
    a_xx = p["IHxx"] + p["IFxx"] + m_h * (z_h - z_a) ** 2 + m_f * (r_f + z_a) ** 2
    a_xz = p["IHxz"] - m_h * (x_h - x_a) * (z_h - z_a) + m_f * (w - x_a) * (r_f + z_a)
    a_zz = p["IHzz"] + p["IFxx"] + m_h * (x_h - x_a) ** 2 + m_f * (w - x_a) ** 2
    # its distance from and moments about the steering axis (lambda)
    u_a = (x_a - w - c) * cl - z_a * sl
    a_ll = m_a * u_a**2 + a_xx * sl**2 + 2 * a_xz * sl * cl + a_zz * cl**2
    a_lx = -m_a * u_a * z_a + a_xx * sl + a_xz * cl
    a_lz = m_a * u_a * x_a + a_xz * sl + a_zz * cl
    trail = c * cl / w  # mu
    # gyroscopic and static coefficients
    s_f = p["IFyy"] / r_f
    s_t = p["IRyy"] / r_r + s_f
    s_a = m_a * u_a + trail * m_t * x_t
    m_off = a_lx + trail * t_xz
    zero = 0 * s_a
    return {
        "M": [[t_xx, m_off], [m_off, a_ll + 2 * trail * a_lz + trail**2 * t_zz]],
        "C1": [
            [zero, trail * s_t + s_f * cl + t_xz * cl / w - trail * m_t * z_t],
            [-(trail * s_t + s_f * cl), a_lz * cl / w + trail * (s_a + t_zz * cl / w)],
        ],
        "K0": [[m_t * z_t, -s_a], [-s_a, -s_a * sl]],
        "K2": [[zero, (s_t - m_t * z_t) * cl / w], [zero, (s_a + s_f * sl) * cl / w]],
    }


# of the eigenvalues of weave and capsize, of the weave and of the capsize speed, by Meijaard's formulas in 40
# digits
AT_5 = {
    "w": (0.5784301836667 + 11.04402541662j, 1.873378311812, -0.4776030485691, -4.393049781489),
    "c": (12.18560145265 - 4.418538571895j, -9.374190592203, 11.47995745126, 28.88866886342),
    "lam": (2.459557200396 - 13.16293523872j, -3.350671972655, 4.17667019102, 4.308855800463),
    "IHxz": (6.303428046764 + 0.2400400242343j, -0.01621194815966, 3.543504519167, 0.0),
    "rF": (5.201300621719 - 13.39003429778j, -4.130519197482, 5.060813989216, 10.27615086865),
    "IFyy": (-6.103847637971 + 13.04502488696j, 4.513883751204, -5.797062739492, -11.41978760738),
}


def state_matrix(v: float, m=M, c1=C1, k0=K0, k2=K2, gravity: float = 9.81) -> np.ndarray:
    """A of d/dt (roll, steer, roll rate, steer rate)."""
    lower = np.linalg.solve(m, -np.hstack([gravity * k0 + v**2 * k2, v * c1]))
    return np.vstack([np.hstack([np.zeros((2, 2)), np.eye(2)]), lower])
