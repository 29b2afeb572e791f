"""What a call of `simulate` with functions of time costs: nothing is compiled twice, what is compiled is
dropped again, and numbers stay numbers.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from figures import fresh
from numpy.testing import assert_allclose
from small_scenes import OnPlane

import jourdain_jax as jj

K = 2.0


class Pushed(OnPlane):
    """A mass that two inputs push, on a spring."""

    stiffness: float = jj.parameter(4.0, unit="N/m")
    inputs = jj.inputs("f g")

    def loads(self, motion):
        return (
            jj.generalized_force(
                motion, x_rate=motion.inputs.f - self.stiffness * motion.q.x, y_rate=motion.inputs.g
            ),
        )


TS = np.array([0.0, 0.5, 1.0])


def moved(f, start=None, **options):
    return jj.simulate(Pushed(), {"x": 0.1} if start is None else start, ts=TS, inputs={"f": f}, **options)


def pulled(k):
    """x of the oscillator that k sin(t) pushes from rest at 0.1, at the end."""
    return 0.1 * np.cos(2.0) + k * (2.0 * np.sin(1.0) - np.sin(2.0)) / 6.0


def test_a_new_function_with_other_numbers_compiles_nothing(compilations):
    table = np.array([0.0, 1.0, 3.0])
    kinds = {
        "number": lambda k: lambda t: k * jnp.sin(t),
        "array": lambda k: functools.partial(lambda a, t: a * jnp.sin(t), jnp.asarray(k)),
        "table": lambda k: lambda t: k * jnp.sin(t) + 0.0 * jnp.interp(t, table, k * table),
    }
    options = {"start": jj.start(Pushed(), x=0.1), "formulation": jj.Formulation(stabilisation=None)}
    for make in kinds.values():
        assert_allclose(moved(make(1.0), **options)["x"][-1], pulled(1.0), atol=1e-7)
        before = len(compilations)
        for k in (2.0, 3.5):
            assert_allclose(moved(make(k), **options)["x"][-1], pulled(k), atol=1e-7)
        assert len(compilations) == before


def test_the_same_function_with_a_rule_of_its_own_compiles_once(compilations):
    @jax.custom_jvp
    def sine(t):
        return jnp.sin(t)

    sine.defjvp(lambda primals, tangents: (jnp.sin(primals[0]), jnp.cos(primals[0]) * tangents[0]))

    def force(t):
        return 2.0 * sine(t)

    moved(force)
    before = len(compilations)
    assert_allclose(moved(force)["x"][-1], pulled(2.0), atol=1e-7)
    assert len(compilations) == before


def test_a_function_whose_global_or_closure_has_changed_is_another_function():
    global K
    box = [1.0]

    def by_global(t):
        return K * jnp.sin(t)

    def by_box(t):
        return box[0] * jnp.sin(t)

    def by_helper(t):
        return jnp.where(t < 5.0 * K, K, 0.0) * jnp.sin(t)

    for k in (2.0, 4.0, -1.0):
        K, box[0] = k, k
        wanted = {by_global: k, by_box: k, by_helper: k if k > 0 else 0.0}
        for f, amplitude in wanted.items():
            assert_allclose(moved(f)["x"][-1], pulled(amplitude), atol=1e-7)
    K = 2.0


def test_a_function_of_time_serves_outside_of_jit_and_inside_in_turn():
    def force(t):
        return 2.0 * jnp.sin(t)

    compiled = jax.jit(lambda start: moved(force, start)["x"][-1])
    start = jj.start(Pushed(), x=0.1)
    for run in (lambda: moved(force, start)["x"][-1], lambda: compiled(start)) * 3:
        assert_allclose(run(), pulled(2.0), atol=1e-7)


def test_the_structure_of_a_scene_is_found_without_compiling_its_constants(compilations):
    class Turned(jj.models.TiltingDisc):
        """A class of its own, of which nothing is known yet."""

    scene = Turned()
    before = len(compilations)
    jj.structure_of(scene)
    assert len(compilations) - before <= 3


WARM_CALL = """
import cProfile, pstats
import numpy as np, jourdain_jax as jj
from jourdain_jax.kernels import host
host.EFFORT = 0  # of LLVM, as in the other tests
disc = jj.models.TiltingDisc()
values, counts = {"lean": 0.3, "spin_rate": -3.0}, []
for start in (values, jj.start(disc, **values)):
    def run():
        return jj.simulate(disc, start, ts=np.array([0.5]))
    run()
    profile = cProfile.Profile()
    profile.runcall(run)
    counts.append(pstats.Stats(profile).total_calls)
print(counts)
"""


def test_a_warm_call_from_python_is_short():
    """Counted in calls of Python functions, which no other load on the machine changes, in a process that
    checks no types.
    """
    of_names, of_state = fresh(WARM_CALL)
    assert of_state < 590  # 536 at the time of writing
    assert of_names < 760  # 698 at the time of writing: a program for the start, and one for the motion


def test_calls_run_few_files():
    """Counted in files of the package of which a function runs (`bench/code_map.py`)."""
    program = "import code_map, json; print(json.dumps(code_map.observed_calls('tilting-disc')))"
    found = fresh(program, JOURDAIN_JAX_CACHE="0").values()  # of build, first, gradient, warm
    assert (np.array([*map(len, found)]) <= [69, 37, 48, 13]).all(), found


LOSSES = {
    "default": {},
    "dense": {"backend": "dense"},
    "Kvaerno5": {"solver": diffrax.Kvaerno5(), "work": False},
}


@pytest.mark.parametrize("options", LOSSES.values(), ids=LOSSES)
def test_gradients_reach_what_an_input_function_closes_over_without_jit(options):
    slope = jax.grad(lambda k: moved(lambda t: k * jnp.sin(t), **options)["x"][-1])(1.5)
    assert_allclose(slope, pulled(1.0) - pulled(0.0), rtol=1e-5)
