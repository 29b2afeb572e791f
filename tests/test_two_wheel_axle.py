"""Two wheels on a rigid axle (Wang and Pao 2003, section VI): Methods I, II, III and the redundant rows are
one motion.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form_runs import end_error
from derivatives import derivatives
from oracles import two_wheel_axle
from solved_states import solved_at_random_states
from tolerances import CLOSED_FORM, ROUND_OFF, relative_error

import jourdain_jax as jj
from jourdain_jax.equations import constraint_rows
from jourdain_jax.models import (
    TwoWheelAxleCoordinates,
    TwoWheelAxleFree,
    TwoWheelAxleQuasi,
    TwoWheelAxleRedundant,
)

PARAMETERS = {"radius": 0.27, "length": 0.9, "mass": 1.7, "rim_mass": 0.4, "slope": 0.35}
# Method -> names of the heading, of psidot_1 and of phidot.
NAMES = {
    TwoWheelAxleFree: ("phi1", "psi1_rate", "phi1_rate"),
    TwoWheelAxleRedundant: ("phi1", "psi1_rate", "phi1_rate"),
    TwoWheelAxleCoordinates: ("phi", "psi1_rate", "phi_rate"),
    TwoWheelAxleQuasi: ("phi", "rolling", "turning"),
}
every_method = pytest.mark.parametrize("method", NAMES)


@every_method
def test_the_accelerations_obey_appells_equations_64(method):
    scene = method(**PARAMETERS)
    heading, rolling, turning = NAMES[method]
    q, _, udot, _ = solved_at_random_states(scene)
    psi1, phi = udot[rolling], udot[turning]
    a, l, M, m = scene.radius, scene.length, scene.mass, scene.rim_mass
    drive = M * scene.gravity * jnp.sin(scene.slope) * jnp.cos(q[heading])
    first = 2 * a * (M + m) * psi1 - l * (M + m) * phi - 2 * drive
    second = a * l * (M + m) * psi1 - (M * l**2 + m * l**2 + m * a**2) * phi - l * drive
    assert relative_error(first, 0 * first, size=2 * jnp.max(jnp.abs(drive))) <= ROUND_OFF
    assert relative_error(second, 0 * second, size=l * jnp.max(jnp.abs(drive))) <= ROUND_OFF


@every_method
@pytest.mark.parametrize("turn_rate", [two_wheel_axle.RUN["phi_rate"], 0.0], ids=["turning", "straight"])
def test_the_motion_is_the_closed_form(method, turn_rate):
    run = two_wheel_axle.RUN | {"phi_rate": turn_rate}
    scene = method(
        **{name: run[name] for name in ("radius", "length", "mass", "rim_mass", "slope", "gravity")}
    )
    _, rolling, turning = NAMES[method]
    start = {"y2": run["length"], rolling: run["psi1_rate"], turning: turn_rate}
    columns = {rolling: "psi1_rate", turning: "phi_rate"} | ({"y1": "y1"} if turn_rate else {})
    assert end_error(scene, start, two_wheel_axle.motion, run, "x1 psi1 x2 y2 psi2", **columns) <= CLOSED_FORM


def _rank_of_eleven_rows(heading, without=None):
    scene = TwoWheelAxleRedundant(**PARAMETERS)
    q, u, _ = scene.named(phi1=heading, phi2=heading, z1=0.27, z2=0.27)
    rows = _rows(scene, q, u)
    assert len(rows.names) == 11
    kept = [i for i, name in enumerate(rows.names) if name != without]
    return np.linalg.matrix_rank(np.asarray(rows.A)[kept])


_rows = eqx.filter_jit(lambda scene, q, u: constraint_rows(scene, 0.0, q, u))


@pytest.mark.parametrize(("row", "heading"), [("axle along x", 0.0), ("axle along y", np.pi / 2)])
def test_neither_axle_row_may_be_dropped_as_redundant(row, heading):
    assert _rank_of_eleven_rows(0.7, without=row) == 10  # it looks redundant at a random heading
    assert _rank_of_eleven_rows(heading, without=row) == 9
    assert row not in jj.structure_of(TwoWheelAxleRedundant(**PARAMETERS)).redundant_rows


def _rolling_acceleration(reduction, x):
    """psi1'' of the eleven rows, at speeds on the rows for every x, so that their rank stays 10."""
    a, l, M, m, slope, phi = x
    scene = TwoWheelAxleRedundant(a, l, M, m, slope)
    psi1, turn = 1.3, 0.5
    psi2 = psi1 - l / a * turn
    c, s = jnp.cos(phi), jnp.sin(phi)
    speeds = {
        "x1_rate": a * c * psi1,
        "y1_rate": a * s * psi1,
        "x2_rate": a * c * psi2,
        "y2_rate": a * s * psi2,
    }
    speeds |= {"psi1_rate": psi1, "psi2_rate": psi2, "phi1_rate": turn, "phi2_rate": turn}
    q, u, _ = scene.named(phi1=phi, phi2=phi, z1=a, z2=a, **speeds)
    solved = jj.accelerations(scene, 0.0, q, u, reduction=reduction)
    return solved.udot[scene.speed_names.entries.index("psi1_rate")]


@pytest.mark.parametrize(
    "name", ["qr", "privileged", "svd", "kkt", "udwadia-kalaba"]
)  # half a minute of compilation each
def test_derivatives_through_dependent_rows_are_those_of_equation_64(name):
    reduction = jj.reductions(TwoWheelAxleRedundant())[name]
    directions = jax.random.normal(jax.random.key(0), (2, 6))

    def exact(x):
        a, _, M, m, slope, phi = x
        return M * 9.81 * jnp.sin(slope) * jnp.cos(phi) / (a * (M + m))

    differentiate = jax.jit(
        lambda x: derivatives(lambda x: _rolling_acceleration(reduction, x), x, directions)
    )
    for heading in (0.4, 0.0, np.pi / 2):
        x = jnp.array([0.27, 0.9, 1.7, 0.4, 0.35, heading])
        expected = derivatives(exact, x, directions)
        for mode, value in differentiate(x).items():
            assert relative_error(value, expected[mode]) <= ROUND_OFF, f"{mode} at heading {heading}"
