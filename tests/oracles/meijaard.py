"""Linearised equations of the Whipple bicycle in closed form, and the benchmark's published numbers.

    M q'' + v C1 q' + (g K0 + v^2 K2) q = f,   q = (lean, steer)

Source: Meijaard, Papadopoulos, Ruina & Schwab, "Linearized dynamics equations for the balance and steer of a bicycle:
a benchmark and review", Proc. R. Soc. A 463 (2007), appendix A (formulas), tables 1 and 2 (numbers). Axes: x forward,
z down, origin at the rear contact; R rear wheel, B rear frame with rider, H handlebar and fork, F front wheel.
"""

import jax.numpy as jnp
import numpy as np

BENCHMARK_M = np.array([[80.81722, 2.319413322087091347748], [2.319413322087091347748, 0.2978418819968555299862]])
BENCHMARK_C1 = np.array([[0.0, 33.86641391492494388276], [-0.8503564145697843703629, 1.685403973975596741057]])
BENCHMARK_K0 = np.array([[-80.95, -2.599516852498716407343], [-2.599516852498716407343, -0.8032948845861768808105]])
BENCHMARK_K2 = np.array([[0.0, 76.59734589573222151899], [0.0, 2.654315237946040252254]])
BENCHMARK_G = 9.81  # m/s^2

BENCHMARK_WEAVE_SPEED = 4.2923825363411039587  # m/s
BENCHMARK_WEAVE_FREQUENCY = 3.43503384866144  # rad/s, at the weave speed
BENCHMARK_CAPSIZE_SPEED = 6.0242620153883588899  # m/s
BENCHMARK_DOUBLE_ROOT_SPEED = 0.68428307889246  # m/s
BENCHMARK_DOUBLE_ROOT_EIGENVALUE = 3.78290405129320  # 1/s

# Rows: speed, castering, capsize, weave real part, weave imaginary part. At v = 0 the last two are two real roots.
BENCHMARK_EIGENVALUES = np.array([
    [0, -5.53094371765393464, -3.13164324790655567, 3.13164324790655567, 5.53094371765393464],
    [1, -7.11008014637440773, -3.13423125066578423, 3.52696170990069417, 0.807740275199310045],
    [2, -8.67387984831737163, -3.07158645641514251, 2.68234517512737345, 1.68066296590675776],
    [3, -10.3510146724592282, -2.63366137253665296, 1.70675605663973515, 2.31582447384324357],
    [4, -12.1586142657644397, -1.42944427361325745, 0.413253315211241321, 3.07910818603205363],
    [5, -14.0783896927972482, -0.322866429004087078, -0.775341882195841925, 4.46486771378822514],
    [6, -16.085371230980284, -0.00406690076970336242, -1.52644486584141715, 5.87673060598708403],
    [7, -18.1578846612520209, 0.102681705747664159, -2.13875644258363428, 7.19525913329804255],
    [8, -20.279408943945663, 0.143278797657129498, -2.69348683581094772, 8.4603797139693359],
    [9, -22.4378855904085906, 0.157901840309172982, -3.21675402252490747, 9.69377351531782195],
    [10, -24.6245963501740002, 0.161053386531715542, -3.72016840437287573, 10.906811394762882],
])


def meijaard_matrices(parameters):
    """M, C1, K0, K2 (each 2 x 2) of appendix A from a mapping of the parameter names to numbers or JAX scalars."""
    p = parameters
    w, c, lam = p["w"], p["c"], p["lam"]
    sin, cos = jnp.sin(lam), jnp.cos(lam)

    # The whole bicycle, T (A1-A6); wheels are symmetric, Izz = Ixx.
    mT = p["mR"] + p["mB"] + p["mH"] + p["mF"]
    xT = (p["xB"] * p["mB"] + p["xH"] * p["mH"] + w * p["mF"]) / mT
    zT = (-p["rR"] * p["mR"] + p["zB"] * p["mB"] + p["zH"] * p["mH"] - p["rF"] * p["mF"]) / mT
    ITxx = (
        p["IRxx"] + p["IBxx"] + p["IHxx"] + p["IFxx"]
        + p["mR"] * p["rR"] ** 2 + p["mB"] * p["zB"] ** 2 + p["mH"] * p["zH"] ** 2 + p["mF"] * p["rF"] ** 2
    )
    ITxz = p["IBxz"] + p["IHxz"] - p["mB"] * p["xB"] * p["zB"] - p["mH"] * p["xH"] * p["zH"] + p["mF"] * w * p["rF"]
    ITzz = (
        p["IRxx"] + p["IBzz"] + p["IHzz"] + p["IFxx"]
        + p["mB"] * p["xB"] ** 2 + p["mH"] * p["xH"] ** 2 + p["mF"] * w**2
    )

    # The front assembly, A, about its own centre of mass (A7-A13).
    mA = p["mH"] + p["mF"]
    xA = (p["xH"] * p["mH"] + w * p["mF"]) / mA
    zA = (p["zH"] * p["mH"] - p["rF"] * p["mF"]) / mA
    IAxx = p["IHxx"] + p["IFxx"] + p["mH"] * (p["zH"] - zA) ** 2 + p["mF"] * (p["rF"] + zA) ** 2
    IAxz = p["IHxz"] - p["mH"] * (p["xH"] - xA) * (p["zH"] - zA) + p["mF"] * (w - xA) * (p["rF"] + zA)
    IAzz = p["IHzz"] + p["IFxx"] + p["mH"] * (p["xH"] - xA) ** 2 + p["mF"] * (w - xA) ** 2
    uA = (xA - w - c) * cos - zA * sin
    IAll = mA * uA**2 + IAxx * sin**2 + 2 * IAxz * sin * cos + IAzz * cos**2
    IAlx = -mA * uA * zA + IAxx * sin + IAxz * cos
    IAlz = mA * uA * xA + IAxz * sin + IAzz * cos

    # Mechanical trail over wheelbase, gyrostatic and static moments (A17-A19).
    mu = c / w * cos
    SR, SF = p["IRyy"] / p["rR"], p["IFyy"] / p["rF"]
    ST = SR + SF
    SA = mA * uA + mu * mT * xT

    # (A20), (A22), (A24), (A26)
    M_lean_steer = IAlx + mu * ITxz
    M = [[ITxx, M_lean_steer], [M_lean_steer, IAll + 2 * mu * IAlz + mu**2 * ITzz]]
    C1 = [
        [0.0, mu * ST + SF * cos + ITxz / w * cos - mu * mT * zT],
        [-(mu * ST + SF * cos), IAlz / w * cos + mu * (SA + ITzz / w * cos)],
    ]
    K0 = [[mT * zT, -SA], [-SA, -SA * sin]]
    K2 = [[0.0, (ST - mT * zT) / w * cos], [0.0, (SA + SF * sin) / w * cos]]
    return tuple(jnp.array(matrix) for matrix in (M, C1, K0, K2))
