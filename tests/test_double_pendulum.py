"""The double pendulum with rods, in angles and as a chain of two: three descriptions of one motion."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import double_pendulum as oracle
from tolerances import relative_error, tolerance

import jourdain_jax as jj
from jourdain_jax.models import DoublePendulumAngles, DoublePendulumRods, PendulumChain

ANGLES, RODS = DoublePendulumAngles(), DoublePendulumRods()
CHAIN = PendulumChain(links=2, mass=jnp.array([1.0, 0.7]), length=jnp.array([1.0, 0.8]))
TIMES = np.linspace(0.0, oracle.RUN["t_end"], 6)
EXPECTED = oracle.motion(TIMES, **oracle.RUN)
CARTESIAN = {f"{axis}{k}": EXPECTED[f"{oracle_axis}{k}"][0] for k in (1, 2) for axis, oracle_axis in (("x", "x"), ("z", "y"))}
CARTESIAN |= {f"{axis}{k}_rate": EXPECTED[f"v{oracle_axis}{k}"][0] for k in (1, 2) for axis, oracle_axis in (("x", "x"), ("z", "y"))}
SIZE = 1.8  # m, the reach


def test_defaults_are_those_of_the_reference_run():
    for scene in (ANGLES, RODS):
        values = {"mass1": "m1", "mass2": "m2", "length1": "l1", "length2": "l2", "gravity": "gravity"}
        assert {name: float(getattr(scene, name)) for name in values} == {name: oracle.RUN[key] for name, key in values.items()}


def test_in_angles_it_follows_the_reference():
    motion = jj.simulate(ANGLES, ts=jnp.asarray(TIMES), rtol=1e-12, atol=1e-12)
    for name, key in (("theta1", "th1"), ("theta2", "th2"), ("theta1_rate", "th1_rate"), ("theta2_rate", "th2_rate")):
        assert relative_error(motion[name], EXPECTED[key]) <= tolerance("closed_form"), name


@pytest.mark.parametrize("scene", [RODS, CHAIN], ids=lambda s: type(s).__name__)
def test_on_rods_it_follows_the_same_reference(scene):
    motion = jj.simulate(scene, CARTESIAN, ts=jnp.asarray(TIMES), rtol=1e-12, atol=1e-12)
    # no choice of two Cartesian velocities stays independent while the rods turn round
    assert motion.state_form == "full"
    for k in (1, 2):
        for name, key in ((f"x{k}", f"x{k}"), (f"z{k}", f"y{k}"), (f"x{k}_rate", f"vx{k}"), (f"z{k}_rate", f"vy{k}")):
            assert relative_error(motion[name], EXPECTED[key], SIZE) <= tolerance("closed_form"), name
    energy = motion.energies().balance
    assert relative_error(energy, EXPECTED["energy"]) <= tolerance("closed_form")


def test_multipliers_are_the_thrusts_in_the_rods():
    names = jj.structure_of(RODS).row_names
    q, u, _ = RODS.named(**CARTESIAN)
    found = dict(zip(names, jj.accelerations(RODS, 0.0, q, u).multipliers, strict=True))
    for row, key in (("upper rod", "tension1"), ("lower rod", "tension2")):
        assert abs(found[row] + EXPECTED[key][0]) <= tolerance("round_off") * EXPECTED["tension1"][0]
