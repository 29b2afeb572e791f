"""Where a function jumps: between two neighbouring numbers; what is only steep, or rounded, does not."""

import jax.numpy as jnp
import numpy as np
import pytest

from jourdain_jax.calculus.jumps import jumps

ENDS = np.linspace(0.0, 10.0, 101)[:, None]


def found(f):
    return list(jumps(lambda t: np.asarray(f(t), float), ENDS[:-1], ENDS[1:]))


@pytest.mark.parametrize("at", [0.003, 0.3, 7.7])
def test_a_jump_lies_between_the_points_that_are_named(at):
    (k, before, behind), *others = found(lambda t: np.concatenate([np.sin(t), t >= at], axis=1))
    assert not others
    assert k == 1
    assert before[0] < at <= behind[0]
    assert behind[0] - before[0] < 1e-14


def test_what_bends_or_is_steep_does_not_jump():
    assert not found(lambda t: np.concatenate([np.abs(t - 0.5), np.tanh(1e6 * (t - 0.5))], axis=1))


def test_numbers_rounded_to_single_precision_do_not_jump(monkeypatch):
    rounded = lambda t: np.clip(np.sin(np.float32(50.0) * np.asarray(t, np.float32)), -0.5, 0.5)  # noqa: E731
    assert found(rounded)
    monkeypatch.setattr(jnp, "result_type", lambda _: np.dtype(np.float32))
    assert not found(rounded)
    assert len(found(lambda t: np.where(t < 0.3, rounded(t), 3.0))) == 1
