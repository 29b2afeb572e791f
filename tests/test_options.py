"""Options: one object for `simulate`, `rollout`, `fit`, studies and likelihoods, given whole or by the names of its fields."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj

SLEIGH, START, TS = jj.models.ChaplyginSleigh(), {"x_rate": 0.6, "heading_rate": 0.9}, np.array([0.5, 1.0])
DATA = jj.Experiment(TS, {"x": np.array([0.3, 0.5])}, 0.01, start=START)
STUDY = jj.Study(SLEIGH, vary={"offset": [0.2, 0.3]})
CALLS = {
    "simulate": lambda **options: jj.simulate(SLEIGH, START, ts=TS, **options),
    "rollout": lambda **options: jj.rollout(SLEIGH, {"x_rate": np.array([0.6])}, ts=TS, **options),
    "fit": lambda **options: jj.fit(SLEIGH, DATA, ("offset",), **options),
    "fit_batch": lambda **options: jj.fit_batch(SLEIGH, DATA, ("offset",), **options),
    "log_likelihood": lambda **options: jj.log_likelihood(SLEIGH, DATA, **options),
    "log_density": lambda **options: jj.log_density(SLEIGH, DATA, ("offset",), **options),
    "planned_information": lambda **options: jj.planned_information(SLEIGH, DATA, ("offset",), **options),
    "filtered_log_likelihood": lambda **options: jj.filtered_log_likelihood(SLEIGH, DATA, process_noise={}, **options),
    "Study.run": lambda **options: STUDY.run("nowhere", **options),
}


@pytest.mark.parametrize("name", CALLS)
def test_an_unknown_option_is_a_type_error_that_names_the_nearest(name):
    with pytest.raises(TypeError, match=rf"{name}\(\) got an unexpected keyword argument 'rtoll'; did you mean `rtol`"):
        CALLS[name](rtoll=1e-6)


@pytest.mark.parametrize(
    ("name", "options", "why"),
    [
        ("fit", {"ts": TS}, "each `Experiment` states start, times and inputs"),
        ("fit", {"retry": True}, "its motions are compiled"),
        ("log_likelihood", {"events": False}, "ends with its last sample"),
        ("Study.run", {"parameters": None}, "what is kept is said by `outputs` and `save`"),
    ],
)
def test_an_option_without_meaning_for_a_function_is_refused_with_the_reason(name, options, why):
    with pytest.raises(TypeError, match=why):
        CALLS[name](**options)


@pytest.mark.parametrize("name", ["saveat", "stepsize_controller", "dt0", "adjoint"])
def test_an_option_that_went_names_what_serves(name):
    for call in CALLS.values():
        with pytest.raises(TypeError, match=f"`{name}` is no option any more: (give |all motions).* call `diffrax.diffeqsolve|the first step is"):
            call(**{name: None})


def test_an_object_and_its_fields_by_name_ask_for_the_same_and_names_replace_fields():
    coarse = jj.Options(rtol=1e-4, atol=1e-4, max_step=np.inf)
    by_name = jj.simulate(SLEIGH, START, ts=TS, rtol=1e-4, atol=1e-4, max_step=np.inf)
    mixed = jj.simulate(SLEIGH, START, ts=TS, options=jj.Options(rtol=1e-4, atol=1e-9), atol=1e-4, max_step=np.inf)
    for motion in (jj.simulate(SLEIGH, START, ts=TS, options=coarse), mixed):
        np.testing.assert_array_equal(motion.q, by_name.q)
        assert int(motion.accepted) == int(by_name.accepted)
    lanes = jj.rollout(SLEIGH, START | {"x_rate": np.array([0.6, 0.7])}, ts=TS, options=coarse)
    assert int(lanes.lane(0).accepted) == int(by_name.accepted)
    assert float(jj.log_likelihood(SLEIGH, DATA, options=coarse)) == float(jj.log_likelihood(SLEIGH, DATA, rtol=1e-4, atol=1e-4, max_step=np.inf))


def test_options_are_a_tree_whose_numbers_may_be_traced():
    def end(options):
        return jj.simulate(SLEIGH, START, ts=TS, options=options, solver=jj.RadauIIA()).q_end

    options = jj.Options(rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(jax.jit(end)(options), end(options), rtol=0, atol=1e-12)
    assert len(jax.tree.leaves(jax.tree.map(jnp.asarray, options))) == 2
