"""Results show the same text when printed, in a console and in a notebook, and say what they are while they are being traced."""

import html

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh, TiltingDisc, TrailerChain

SLEIGH = ChaplyginSleigh()
RUN = {"t1": 0.2, "ts": jnp.linspace(0.0, 0.2, 5)}


def test_round_off_is_printed_as_zero():
    state = jj.start(jj.models.DoublePendulumRods(), {"x1": 0.6, "z1": -0.8})
    small = eqx.tree_at(lambda s: (s.q, s.u), state, (state.q.at[0].set(-1.3e-136), state.u.at[1].set(2e-17)))
    assert "x1 = 0," in str(small)
    assert "z1_rate = 0," in str(small)
    tiny = eqx.tree_at(lambda s: (s.q, s.u), state, (1e-30 * state.q, 1e-30 * state.u))
    assert "x1 = 6e-31" in str(tiny)


def measured():
    motion = jj.simulate(SLEIGH, {"x_rate": 0.6, "heading_rate": 0.9}, **RUN)
    return jj.Experiment(motion.ts, {"heading": motion["heading"], "x": motion["x"]}, 0.01, start={"x_rate": 0.6, "heading_rate": 0.9})


def fitted():
    return jj.fit(SLEIGH, measured(), "offset")


RESULTS = {
    "State": (lambda: jj.start(SLEIGH, heading_rate=0.5), "State at t = 0 s: x = 0"),
    "Report": (lambda: jj.report(SLEIGH), "Report on ChaplyginSleigh"),
    "Verification": (lambda: jj.verify(SLEIGH, {"heading_rate": 0.5}), "Verification of ChaplyginSleigh: passed"),
    "Rollout": (lambda: jj.rollout(SLEIGH, {"heading_rate": np.array([0.5, 0.6])}, progress=False, **RUN), "Rollout of ChaplyginSleigh: 2 lanes"),
    "Fit": (fitted, "Fit of ChaplyginSleigh: converged"),
    "Estimated": (lambda: fitted()["offset"], f"{SLEIGH.offset:.3g} m, standard error"),
    "Profile": (lambda: fitted().profiles(measured())["offset"], f"`offset` = {SLEIGH.offset:.3g} m, profile"),
    "Prediction": (lambda: fitted().predict(measured())[0]["x"], "5 samples from 0 to"),
    "ChannelResiduals": (lambda: fitted().residual_summary()[0], "residuals of `heading` of run 0, in sigmas: 5 samples"),
    "SteadyMotion": (lambda: jj.steady(SLEIGH, {"x_rate": 0.5}, held="x_rate"), "steady motion: residual"),
    "Linearization": (lambda: jj.linearize(SLEIGH, {"x_rate": 0.5}, ()), "Small motions: residual"),
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_shows_its_text_wherever_it_is_shown(name):
    make, begins = RESULTS[name]
    result = make()
    assert type(result).__name__ == name
    assert str(result).startswith(begins)
    assert repr(result) == str(result)
    assert result._repr_html_().startswith(f"<pre>{html.escape(str(result))}</pre>")


def test_a_scene_shows_its_numbers_as_one_writes_them():
    assert repr(ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25)) == str(ChaplyginSleigh()) == "ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25)"
    assert str(TrailerChain(trailers=0)).startswith("TrailerChain(trailers=0, car_mass=1, ")
    seen = []
    jax.jit(lambda scene: seen.append(str(scene)))(SLEIGH)
    assert seen == ["ChaplyginSleigh(mass=being traced, inertia=being traced, offset=being traced)"]


def test_a_linearization_prints_its_matrices_by_name_and_its_eigenvalues():
    chain = jj.linearize(TrailerChain(trailers=0), {"forward0": 1.0}, ())
    text = str(chain)
    for part in ("A ", "B ", "forward0", "turn0", "drive", "eigenvalues in 1/s: "):
        assert part in text
    disc = jj.linearize(TiltingDisc(), {"spin_rate": -3.0}, ("lean", "yaw"))
    for part in ("M ", "C ", "K ", "lean", "yaw", "eigenvalues in 1/s: "):
        assert part in str(disc)


@pytest.mark.slow
def test_linearizations_of_a_batch_print_their_shape_and_names():
    small = jax.vmap(lambda s: jj.linearize(TiltingDisc(), jj.start(TiltingDisc(), spin_rate=s), ("lean",)))(jnp.array([-3.0, -4.0]))
    assert str(small) == "Linearizations of shape (2,); named coordinates: lean"


def test_a_batch_of_states_lists_its_names():
    states = jax.vmap(lambda x: jj.start(SLEIGH, x=x))(jnp.arange(3.0))
    assert str(states).startswith("States of shape (3,): x, y, heading")


def test_printing_a_traced_result_says_its_shapes():
    texts = []

    @jax.jit
    def traced(turning):
        motion = jj.simulate(SLEIGH, {"heading_rate": turning}, **RUN)
        texts.extend([str(motion), motion._repr_html_(), str(jj.start(SLEIGH, heading_rate=turning))])
        return motion.q_end

    traced(0.5)
    assert texts[0].startswith("Trajectory, being traced: ")
    assert "the largest of shape (5, 3); print it outside of `jax.jit`, or use `jax.debug.print`" in texts[0]
    assert texts[1] == f"<pre>{texts[0]}</pre>"
    assert texts[2].startswith("State, being traced: ")


def test_an_unknown_name_is_answered_without_quotes_around_the_answer():
    motion = jj.simulate(SLEIGH, {}, **RUN)
    with pytest.raises(KeyError) as caught:
        motion["headin"]
    assert str(caught.value).startswith("a trajectory of `ChaplyginSleigh` has no `headin`; did you mean `heading`? Valid names:")
