"""Generated scenes hold every invariant of mechanics under every reduction: 200 instances in 25 structures,
5,000 behind `-m slow`.

The normal set runs every structure's equations on NumPy, the long one compiles them. Views from moved frames
and in other coordinates, speeds, units and orders take most of the time: the normal set has those of one
structure, the long one all. A failure names structure, invariant, reduction and seed.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from generated_invariants import admitted, evaluated, instances, residuals
from generated_scenes import KINDS, recipe
from tolerances import ROUND_OFF, tolerance

from jourdain_jax import Lowered
from jourdain_jax.equations import instant, virtual_power
from jourdain_jax.equations.rows import ConstraintRows
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.structure.trace import named_values

STRUCTURES = range(25)
PARAMETERS, STATES, LEAST = 2, 5, 8  # per structure: 25 times at least 8 instances make 200
MANY_PARAMETERS, MANY_STATES, MANY = 12, 20, 200  # 5,000 in all
QUICKLY_LOWERED = (13, 16, 22)


def broken(made, found):
    """The invariants that do not hold to round-off, with their largest residuals."""
    largest = {name: float(np.max(values, initial=0.0)) for name, values in residuals(made, found).items()}
    return {name: value for name, value in largest.items() if not value <= ROUND_OFF}


_EVALUATED: dict[int, dict] = {}  # what the first tests have worked out, for those of the scalar programs


def check(number, *, parameters, states, least, seed, compiled, looks=True):
    """All invariants of one structure."""
    made = recipe(number)
    found = evaluated(made, parameters=parameters, states=states, seed=seed, compiled=compiled, looks=looks)
    _EVALUATED[number] = found if not compiled else {}
    where = f"{made}; seed {seed}"
    good = admitted(found)
    assert good.sum() >= least, (
        f"{where}: {good.sum()} instances of {good.size} lie on the rows, away from a loss of rank"
    )
    wrong = broken(made, found)
    assert not wrong, f"{where}: {wrong}"
    for name, applies in found["applicable"].items():
        where_it_must = good & (found["sigma"] > 0.1)
        assert name in ("privileged", "gibbs-appell") or applies[where_it_must].all(), (
            f"{where}: `{name}` does not apply"
        )
    if found[
        "well conditioned"
    ].all():  # by probing: at single states the pivot may be too small, and then the reduction says so
        for name in ("privileged", "gibbs-appell"):
            assert found["applicable"][name][good].mean() >= 0.9, (
                f"{where}: `{name}` applies at {found['applicable'][name][good].sum()} of {good.sum()}"
            )


@pytest.mark.parametrize("number", STRUCTURES)
def test_a_generated_scene_holds_every_invariant(number):
    check(
        number, parameters=PARAMETERS, states=STATES, least=LEAST, seed=0, compiled=False, looks=number == 0
    )


@pytest.mark.parametrize("number", STRUCTURES)
def test_a_generated_scene_holds_every_invariant_at_200_instances(number):
    check(number, parameters=MANY_PARAMETERS, states=MANY_STATES, least=MANY, seed=100, compiled=True)


def test_the_structures_contain_everything_that_can_be_generated():
    made = [recipe(number) for number in STRUCTURES]
    assert len({(r.bodies, r.rows, r.loads, r.own_speeds) for r in made}) == len(made)
    rows = "edge, rod, flat pin, pin, steered row, curve, affine row, timed row, driven, constant speed, copy"
    loads = "weight, spring, damper, well, tide, torque, steering, follower, magnet, drag, gust, input"
    speeds = {"homogeneous quasi-velocities", "affine quasi-velocities"}
    occurring = set().union(*(r.kinds() for r in made))
    assert speeds.union(KINDS, rows.split(", "), {"sum"}, loads.split(", ")) <= occurring
    assert sum(r.reversible for r in made) >= 5
    assert sum(r.scleronomic for r in made) >= 8


def check_lowered(number, every_speed):
    """The scalar program of a structure against the dense path; False where it is not lowered. `every_speed`:
    by multipliers, not by elimination.
    """
    made = recipe(number)
    stacked, scene, t, *_ = instances(made, PARAMETERS, STATES, 0)
    program = lowered(scene, every_speed)
    if not isinstance(program, Lowered):
        return False
    found = _EVALUATED.get(number) or evaluated(made, parameters=PARAMETERS, states=STATES, looks=False)
    good = admitted(found) & found["applicable"]["privileged"]
    inputs = 0.7 * np.ones((len(t), len(scene.inputs)))
    named = named_values(scene, found["t"], found["q"], found["u"], inputs)
    for k, leaf in enumerate(jax.tree.leaves(stacked)):
        columns = np.repeat(np.reshape(leaf, (PARAMETERS, -1)), STATES, axis=0).T
        named |= {f"p{k}_{i}": column for i, column in enumerate(columns)}
    probes = Probes(program.graph, named)
    ydot, z = probes(program.ydot).T[good], probes(program.z).T[good]
    dense, speeds = found["rate"][good], found["u"][good]
    size = np.max(np.abs(dense), axis=1, keepdims=True) + np.max(np.abs(speeds), axis=1, keepdims=True)
    assert np.max(np.abs(ydot - dense[:, list(program.independent)]) / size, initial=0.0) <= tolerance(
        "round_off"
    ), f"{made}: accelerations"
    assert np.max(np.abs(z - speeds[:, list(program.dependent)]) / size, initial=0.0) <= tolerance(
        "round_off"
    ), f"{made}: dependent speeds"
    return True


@pytest.mark.parametrize("every_speed", [False, True])
@pytest.mark.parametrize("number", QUICKLY_LOWERED)
def test_the_scalar_program_of_a_generated_scene_is_its_dense_equations(number, every_speed):
    assert check_lowered(number, every_speed)


def test_the_scalar_programs_of_all_generated_scenes_are_their_dense_equations():
    assert sum(check_lowered(number, False) for number in STRUCTURES) >= 12
    assert sum(check_lowered(number, True) for number in STRUCTURES) >= 20


# Deliberate errors in the engine, each of which some invariant must show: otherwise the tests above could not
# fail.


def _wrong_sign_of_bias(equations_of):
    def wrong(scene, at):
        right = equations_of(scene, at)
        return virtual_power.UnconstrainedEquations(right.M, -right.h, right.Q)

    return wrong


def _row_forgotten(rows_of):
    def wrong(scene, at):
        right = rows_of(scene, at)
        kept = jnp.ones(right.phi.shape[0]).at[-1].set(0.0)  # one that no other row repeats
        return ConstraintRows(right.phi * kept, right.A * kept[:, None], right.drift * kept, right.names)

    return wrong


def _M_not_symmetric(mass_matrix):
    return lambda *of: mass_matrix(*of) + jnp.triu(mass_matrix(*of), 1) * 1e-6


def _gradient_of_potential_halved(gradient):
    return lambda scene, motion: 0.5 * gradient(scene, motion)


def _b_t_forgotten(rates_along_motion):
    def wrong(scene, t, q, u, inputs=None):
        value, rate, motion = rates_along_motion(scene, t, q, u, inputs)
        _, explicit = jax.jvp(
            lambda t: instant._velocity_level(scene, t, q, u, inputs)[0], (t,), (jnp.ones_like(t),)
        )
        return value, jax.tree.map(lambda x, y: x - y, rate, explicit), motion

    return wrong


def _gyroscopic_torque_forgotten(inertia_resultants):
    def wrong(weights, velocity, acceleration):
        force, _ = inertia_resultants(weights, velocity, acceleration)
        return force, jnp.einsum("bij,bj->bi", weights.inertia, acceleration.angular)

    return wrong


def _torques_in_space_axes(impressed):
    def wrong(scene, motion, loads=None):
        right, given = impressed(scene, motion, loads), virtual_power.resultants(scene, motion, loads=loads)
        return virtual_power.Resultants(right.force, given.torque, right.direct)

    return wrong


@pytest.mark.parametrize(
    ("module", "name", "mistaken", "number", "shown_by"),
    [
        (virtual_power, "equations_of", _wrong_sign_of_bias, 13, "h is the gradient of the Gibbs function"),
        (virtual_power, "rows_of", _row_forgotten, 12, "rows hold along the motion"),
        (virtual_power, "mass_matrix", _M_not_symmetric, 12, "M is symmetric"),
        (
            virtual_power,
            "_potential_gradient",
            _gradient_of_potential_halved,
            13,
            "dE/dt is the power of all that works",
        ),
        (instant, "rates_along_motion", _b_t_forgotten, 13, "dE/dt is the power of all that works"),
        (
            virtual_power,
            "inertia_resultants",
            _gyroscopic_torque_forgotten,
            3,
            "h is the gradient of the Gibbs function",
        ),
        (virtual_power, "impressed", _torques_in_space_axes, 3, "dE/dt is the power of impressed forces"),
    ],
)
def test_a_deliberate_error_is_shown_by_an_invariant(module, name, mistaken, number, shown_by, monkeypatch):
    monkeypatch.setattr(module, name, mistaken(getattr(module, name)))
    made = recipe(number)
    wrong = broken(made, evaluated(made, parameters=1, states=3, looks=False))
    assert shown_by in wrong, wrong
