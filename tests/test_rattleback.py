"""The rattleback against Kane and Levinson's equations written out by hand, and their published motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import rattleback as oracle
from tolerances import relative_error

import jourdain_jax as jj
from jourdain_jax.models import Rattleback

STONE = Rattleback()
RUN = {name: oracle.RUN[name] for name in oracle.NAMES}
TIMES = np.sort([*np.arange(21.0), oracle.FIRST_REVERSAL - 1e-6, oracle.FIRST_REVERSAL + 1e-6])


def _saved(motion, time):
    """The compared coordinates and speeds at a whole second."""
    return np.array([float(motion[name][np.flatnonzero(time == TIMES)[0]]) for name in oracle.NAMES])


@pytest.fixture(scope="module")
def motion():
    """20 s of the published motion, saved at whole seconds and about its first reversal. Errors grow by 6e3
    in the first second: hence the tolerances.
    """
    return jj.simulate(STONE, RUN, ts=TIMES, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("time", oracle.TABLE)
def test_all_printed_digits_come_out(motion, time):
    assert np.all(np.abs(_saved(motion, time) - oracle.TABLE[time]) <= oracle.DIGITS[time])


@pytest.mark.parametrize("backend", ["native", "xla"])
def test_the_derivative_of_a_long_motion_at_round_off_is_right(backend):
    """2580 steps: where reverse mode chose its steps once more, its derivative was off by more than 1 %."""
    start = jj.start(STONE, **STONE.example)

    def turned(factor):
        begun = eqx.tree_at(lambda s: s.u, start, factor * start.u)
        motion = jj.simulate(
            STONE,
            begun,
            ts=[2.0],
            rtol=1e-13,
            atol=1e-13,
            formulation=jj.Formulation(stabilisation=None),
            backend=backend,
        )
        return jnp.sum(motion.q_end), motion.accepted

    found, steps = jax.grad(turned, has_aux=True)(1.0)
    assert steps > 2000
    assert_allclose(found, jax.jvp(lambda x: turned(x)[0], (1.0,), (1.0,))[1], rtol=1e-9)


def test_energy_is_kept_through_every_reversal(motion):
    energy = np.asarray(motion.energies().balance)
    assert abs(energy[0] - oracle.ENERGY) <= 1e-14
    assert relative_error(energy, np.full_like(energy, oracle.ENERGY)) <= 1e-10


def test_spinning_the_wrong_way_it_stops_and_turns_back(motion):
    before, after = np.flatnonzero(np.abs(TIMES - oracle.FIRST_REVERSAL) < 1e-5)
    assert motion["w3"][before] < 0 < motion["w3"][after]
