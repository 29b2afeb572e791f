"""Arguments of the wrong kind are answered with what was given, what is expected and what to write, as a user sees it.

The cases run in a process of their own, without the run-time type checks of the other tests, which would answer first.
"""

import json
import os
import subprocess
import sys

import pytest

SCRIPT = """
import json, os, diffrax, jax, jax.numpy as jnp, numpy as np
import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh, TiltingDisc, TrailerChain
Base, b = ChaplyginSleigh, ChaplyginSleigh()
lanes = jj.rollout(b, {"heading_rate": np.array([0.5, 0.6])}, t1=0.1, ts=[0.0, 0.1], progress=False)
data = jj.Measurements([0.0, 0.1], {"x": [0.0, 0.0]}, 0.01, start={})
cases = CASES
for code in cases:
    try:
        eval(code)
        print(json.dumps(["nothing", ""]))
    except Exception as error:
        print(json.dumps([type(error).__name__, str(error)]))
"""

CASES = {
    "jj.simulate(Base, {}, t1=1.0)": "`scene` is the class `ChaplyginSleigh`, expected a scene of it; write `ChaplyginSleigh()`",
    "jj.report(Base)": "`scene` is the class `ChaplyginSleigh`",
    "jj.verify(Base, {})": "`scene` is the class `ChaplyginSleigh`",
    "jj.linearize(Base, {})": "`scene` is the class `ChaplyginSleigh`",
    "jj.steady(Base, {})": "`scene` is the class `ChaplyginSleigh`",
    "jj.rollout(Base)": "`scene` is the class `ChaplyginSleigh`",
    "jj.start(Base)": "`scene` is the class `ChaplyginSleigh`",
    "jj.structure_of(Base)": "`scene` is the class `ChaplyginSleigh`",
    "jj.reductions(Base)": "`scene` is the class `ChaplyginSleigh`",
    "jj.accelerations(Base, 0.0, jnp.zeros(3), jnp.zeros(3))": "`scene` is the class `ChaplyginSleigh`",
    "jj.fit(Base, data, 'offset')": "`scene` is the class `ChaplyginSleigh`",
    "jj.simulate(3.0, {}, t1=1.0)": "`scene` is a float, expected a scene: an instance of a subclass of `jj.Scene`",
    "jj.simulate(b, 3.0, t1=1.0)": "`start` is a float, expected a State (from `jj.start` or `jj.consistent`), a dictionary of named values, or None",
    "jj.verify(b, 3.0)": "`state` is a float, expected a State",
    "jj.linearize(b, jnp.zeros(3))": "`state` is an array of shape (3,), expected a State",
    "jj.steady(b, None)": "`guess` is `None`, expected a State or a dictionary of named values",
    "jj.simulate(b, {}, t1=1.0, solver='dopri5')": "`solver` is the text 'dopri5', expected an object of diffrax; write `diffrax.Dopri5()`",
    "jj.simulate(b, {}, t1=1.0, solver=diffrax.Tsit5)": "`solver` is the class `Tsit5`, expected an object of diffrax; write `diffrax.Tsit5()`",
    "jj.simulate(b, {}, t1=1.0, adjoint='forward')": "`adjoint` is the text 'forward', expected an object of diffrax; write `diffrax.ForwardMode()`",
    "jj.simulate(b, {}, t1=1.0, stepsize_controller=0.1)": "`stepsize_controller` is a float, expected an object of diffrax; write `diffrax.PID",
    "jj.simulate(b, {}, t1=1.0, saveat=[0.0])": "`saveat` is a list, expected an object of diffrax; write `diffrax.SaveAt(ts=...)`",
    "jj.simulate(b, {}, t1=1.0, rtol=float('nan'))": "`rtol` is nan, expected a positive finite number; give a tolerance such as 1e-8",
    "jj.simulate(b, {}, t1=1.0, atol=-1)": "`atol` is -1, expected a positive finite number",
    "jj.simulate(b, {}, t1=1.0, rtol='tight')": "`rtol` is the text 'tight', expected real numbers; give one number, such as 1e-8",
    "jj.simulate(b, {}, t1=1.0, max_steps=0)": "`max_steps` is 0, expected a whole number of at least 1",
    "jj.simulate(b, {}, t1=1.0, inputs=[1.0])": "`inputs` is a list, expected a dictionary: name -> number, function of time, or `jj.Sampled`",
    "jj.simulate(TrailerChain(), t1=1.0, inputs={'turn': 'hard'})": "input `turn` of `TrailerChain` is the text 'hard', expected real numbers",
    "jj.verify(b, {}, inputs={'force': 1.0})": "`ChaplyginSleigh` has no input `force`; Valid names: none.",
    "jj.linearize(TrailerChain(), None, inputs={'trun': 1.0})": "`TrailerChain` has no input `trun`; did you mean `turn`?",
    "jj.linearize(b, {}, 'headin')": "`ChaplyginSleigh` has no coordinate `headin` to perturb; did you mean `heading`?",
    "jj.steady(b, {}, held='headin')": "`ChaplyginSleigh` has no `headin` to hold or to move; did you mean `heading`?",
    "jj.fit(b, data, 'offst')": "`free` names `offst`, which is no parameter of `ChaplyginSleigh`; did you mean `offset`?",
    "jj.save(lanes.lanes, 'run.npz')": "was given a batch of shape (2,); save a `Rollout`, `jj.Rollout(batch)` for one axis of lanes",
    "jj.save(b, 'run.npz')": "`save` was given a ChaplyginSleigh, expected a `Trajectory` from `jj.simulate` or a `Rollout` from `jj.rollout`",
    "jj.save(lanes, os.getcwd())": "it is a folder; give the name of a file in it, such as motion.npz",
    "jj.save(lanes.lane(0), os.getcwd())": "it is a folder; give the name of a file in it, such as motion.npz",
    "jj.animate(lanes, 'run.gif')": "`animate` was given a Rollout, expected one motion; of a rollout take one lane: jj.animate(rollout.lane(0), 'lane-0.gif')",
    "jj.animate(lanes.lane(0), 'run.mp4')": "cannot write `run.mp4`: an animation is a .gif file",
    "jj.plot(lanes.lane(0), 'x', path='run.xyz')": "cannot write `run.xyz`: a plot is a .png, .svg or .pdf file, and matplotlib knows no `xyz`",
    "jj.Sampled([0, 2, 1], [0, 1, 2])": "the times of `Sampled` must be finite and increase from one to the next; sort the samples by time",
    "jj.Sampled([0, 1], [0, 1, 2])": "`Sampled` was given times of shape (2,) and values of shape (3,), expected two vectors of one length",
    "jj.Sampled(0.0, 1.0)": "`Sampled` was given times of shape () and values of shape ()",
    "jj.Sampled([0, 1], [0, float('nan')])": "value 1 of `Sampled` is nan, expected finite numbers; leave samples out that were not measured",
    "jj.Sampled(['a'], [0])": "`ts` of `Sampled` is a list, expected real numbers; give times in s",
}


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What every case is answered with."""
    source = SCRIPT.replace("CASES", repr(list(CASES)))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "JAX_PLATFORMS": "cpu"}
    folder = tmp_path_factory.mktemp("wrong")
    run = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, env=environment, cwd=folder)
    assert run.returncode == 0, run.stderr
    assert not list(folder.iterdir()), "a refused file was written"
    return dict(zip(CASES, (json.loads(line) for line in run.stdout.splitlines()), strict=True))


@pytest.mark.parametrize("code", CASES)
def test_an_argument_of_the_wrong_kind_is_named_with_what_to_write(code, answers):
    kind, text = answers[code]
    assert CASES[code] in text, text
    assert kind == "ValueError"
