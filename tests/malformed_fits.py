"""Malformed measurements, priors and questions to fits, as one table: see `malformed_inputs`."""

PRELUDE = '''
import jax.numpy as jnp, numpy as np
import jourdain_jax as jj
from small_scenes import Cart

TS = np.linspace(0.0, 4.0, 21)
SWUNG = {"x": 0.3 * np.cos(TS), "x_rate": -0.3 * np.sin(TS)}


def run(**changes):
    """A cart that is pushed, seen at 21 times."""
    given = {
        "ts": TS,
        "values": SWUNG,
        "sigma": {"x": 0.01, "x_rate": 0.02},
        "start": {"x": 0.3, "x_rate": 0.0},
        "inputs": {"push": 1.0},
    } | changes
    return jj.Experiment(given.pop("ts"), given.pop("values"), given.pop("sigma"), **given)


def shown(**numbers):
    """Its speed by a sensor with these numbers, the first sample at 0.2 s."""
    values = {"x": SWUNG["x"], "gyro": np.where(TS < 0.2, np.nan, SWUNG["x_rate"])}
    return run(values=values, sigma=0.01, sensors={"gyro": jj.identification.Sensor("x_rate", **numbers)})


def fitted(**numbers):
    return jj.fit(cart, shown(**numbers), "mass")


def with_input(push):
    return jj.fit(cart, run(inputs={"push": push}), "mass")


cart, gain, command = Cart(), jj.Estimate(1.0), jj.Sampled([0.0, 4.0], [1.0, 1.0])
together = jj.identification.joint_normal({"mass": 2.0, "stiffness": 5.0}, [[0.01, 0.0], [0.0, 0.01]])
density = jj.identification.log_density(
    cart, [run(unknown_start=("x",))] * 2, {"damping": jj.bounds(0.0, 2.0), "stiffness": None}
)
'''

FITS: dict[str, str] = {
    "jj.fit(cart, run(), ('mas',))": "`mas`, which is not a parameter of `Cart`; did you mean `mass`",
    "jj.fit(cart, run(), 'mass', cutoff=1.0)": "`cutoff` is 1.0, expected a number between 0 and 1",
    "jj.fit(cart, run(), 'mass', tolerance=0.0)": "`tolerance` is 0.0, expected a number above zero",
    "jj.fit(cart, run(), 'mass', max_iterations=-1)": "`max_iterations` is -1, expected a whole number",
    "jj.fit(cart, run(), ())": "nothing is free; name parameters in `free`",
    "jj.fit(cart, run(), {'mass': 3.0})": "`mass` was given 3.0; expected `bounds",
    "jj.fit(cart, run(), {'mass': jj.bounds(3.0, 4.0)})": (
        "first guess of `mass` is 2.0; expected a first guess between"
    ),
    "jj.fit(Cart(damping=0.0), run(), 'damping')": (
        "first guess of `damping` is 0.0; expected a first guess above"
    ),
    "jj.fit(cart, [], 'mass')": "`data` is empty, expected an `Experiment` or a sequence",
    "jj.fit(cart, run(values={'x_rat': TS}, sigma=1.0), 'mass')": (
        "unknown channel `x_rat`; did you mean `x_rate`"
    ),
    "jj.fit(cart, run(start={'y': 0.0}), 'mass')": "no coordinate or speed `y`",
    "jj.fit(cart, run(inputs={'pus': 1.0}), 'mass')": "no input `pus`; did you mean `push`",
    "jj.fit(cart, run(values={'x': TS[:5]}, sigma=1.0), 'mass')": "shape (5,), expected (21,) for 21 times",
    "jj.fit(cart, run(values={'x': np.ones((3, 21))}, sigma=1.0), 'mass')": "repeats use `fit_batch`",
    "jj.fit(cart, run(sigma={'x': np.ones(5), 'x_rate': 1.0}), 'mass')": (
        "sigma of channel `x` ... shape (5,)"
    ),
    "jj.fit_batch(cart, run(), 'mass')": "expected (repeats, 21)",
    (
        "jj.fit_batch(cart, run(values={'x': np.ones((3, 21)), 'x_rate': np.ones((2, 21))}, sigma=1.0), "
        "'mass')"
    ): ("hold [2, 3] repeats"),
    "jj.fit(cart, run(values={'x': [0.1, 0.2]}, sigma=1.0, ts=TS[:2]), ('mass', 'damping', 'stiffness'))": (
        "2 measured values cannot determine 3 unknowns"
    ),
    "run(sigma={'x': 0.0, 'x_rate': 1.0})": "sigma of channel `x` must be above zero",
    "run(sigma={'x': np.nan, 'x_rate': 1.0})": "sigma of channel `x` must be above zero",
    "run(sigma={'x': 0.1})": "channel `x_rate` has no sigma",
    "run(sigma={'x': 0.1, 'x_rate': 1.0, 'y': 1.0})": "`sigma` names channel `y`",
    "run(values={'x': np.where(TS[4] == TS, np.inf, TS)}, sigma=1.0)": (
        "infinite values, the first at sample 4; give NaN"
    ),
    "run(values={'x': np.full(21, np.nan)}, sigma=1.0)": "channel `x` holds only NaN",
    "jj.fit(cart, run(), 'mass', errors='hac')": "`errors` is 'hac', expected",
    "jj.fit(cart, run(), 'mass', errors='runs')": (
        "from differences between runs, but there are only 1; give 5 or more"
    ),
    "jj.fit(cart, run(sigma={'x': None, 'x_rate': 1.0}), 'mass', loss=jj.identification.huber())": (
        "sigma of channel `x` is None, but a robust loss"
    ),
    "jj.fit(cart, [run(), run(sigma={'x': None, 'x_rate': 1.0})], 'mass')": (
        "sigma of channel `x` is None in one run and given in another"
    ),
    "jj.identification.log_likelihood(cart, run(sigma=None))": (
        "sigma of channel `x` is None, but a likelihood needs"
    ),
    "jj.identification.huber(0.0)": "huber(0.0): expected a positive finite number",
    "jj.identification.student_t(np.inf)": "student_t(inf): expected a positive finite number",
    "run(values={}, sigma=1.0)": "`values` is empty",
    "run(ts=TS[::-1])": "`ts` must be finite and strictly increasing",
    "run(ts=np.where(TS[4] == TS, TS[3], TS))": (
        "but sample 4 is at 0.6 s after 0.6 s; sort the samples by time and merge repeated"
    ),
    "jj.Experiment([0.0, 1.0, np.inf, np.inf], {'x': np.zeros(4)}, 1.0, start={})": (
        "but sample 2 is at inf s after 1 s"
    ),
    "jj.Experiment([np.nan], {'x': [0.0]}, 1.0, start={})": "but sample 0 is at nan s; sort",
    "run(ts=np.ma.masked_greater(TS, 3.0))": "`ts` is an array of shape ... some are masked",
    "jj.fit(cart, run(values={'x': np.where(TS[4] == TS, 0.1, np.nan)}, sigma=None), 'mass')": (
        "1 measured values ... 1 unknowns and 1 sigmas"
    ),
    (
        "jj.fit(cart, run(values={'a': TS}, sigma=1.0, "
        "sensors={'a': lambda motion: np.sin(motion.q.x)}), 'mass')"
    ): ("write it with `jax.numpy`"),
    (
        "jj.fit(cart, run(values={'a': TS}, sigma=1.0, "
        "sensors={'a': lambda m: abs(m.q.x) if m.q.x > 0 else 0.0}), 'mass')"
    ): ("without `if`"),
    "run(ts=np.where(TS[4] == TS, np.nan, TS))": "`ts` must be finite and strictly increasing",
    "jj.Experiment(TS[:0], {'x': TS}, 1.0, start={})": "expected a vector of at least one time",
    "run(t0=1.0)": "`t0` is 1.0 s, expected at most the time of the first sample",
    "run(unknown_start=('y',))": "unknown start value `y` has no first guess",
    "run(sensors={'place': lambda motion: motion.q.x})": "sensor `place` has no measured values",
    "jj.bounds(2.0, 1.0)": "expected finite numbers low < high",
    "jj.bounds(0.0, np.inf)": "for one bound at zero use `positive",
    "jj.identification.unbounded(0.0)": "expected a positive scale",
    "jj.Experiment('ts', {'x': [0.0]}, 0.01, start={})": (
        "`ts` is the text 'ts', expected real numbers; give a vector of times in s"
    ),
    "jj.Experiment([0.0, 0.1], [0.0, 0.0], 0.01, start={})": (
        "`values` of `Experiment` is a list, expected a dictionary by name"
    ),
    "jj.Experiment([0.0, 0.1], {'x': ['a', 'b']}, 0.01, start={})": (
        "values of channel `x` is a list, expected real numbers"
    ),
    "jj.Experiment([0.0, 0.1], {'x': [0.0, 0.1]}, 'small', start={})": (
        "sigma of channel `x` is the text 'small', expected real numbers"
    ),
    "jj.Experiment([0.0, 0.1], {'x': [0.0, 0.1]}, 0.1, start=None)": (
        "`start` of `Experiment` is `None`, expected a dictionary by name"
    ),
    "jj.Experiment([0.0, 0.1], {'x': [0.0, 0.1]}, 0.1, start={}, t0='a')": (
        "`t0` is the text 'a', expected real numbers; give one time in s"
    ),
    "jj.Experiment([0.0, 0.1], {'x': [0.0, 0.1]}, 0.1, start={}, sensors=3)": (
        "`sensors` of `Experiment` is an int, expected a dictionary"
    ),
    "jj.identification.Actuator('a')": (
        "`command` of `Actuator` is the text 'a', expected `jj.Sampled(ts, values)`"
    ),
    "jj.Estimate('a')": "`guess` of `Estimate` is the text 'a', expected real numbers; give a number",
    "jj.bounds('a', 1.0)": "low end of `bounds` is the text 'a', expected real numbers",
    "jj.identification.unbounded('a')": "`scale` of `unbounded` is the text 'a', expected real numbers",
    "jj.fit(Cart, run(), 'mass')": "`scene` is the class `Cart`",
    "jj.fit(cart, 3, 'mass')": "`data` is an int, expected an `Experiment` or a sequence of at least one",
    "jj.fit(cart, [run(), 3], 'mass')": (
        "`data` holds an int, expected an `Experiment` or a sequence of at least one"
    ),
    "jj.fit(cart, jj.Experiment([0.0, 0.1], {'z': [0.0, 0.1]}, 0.01, start={}), 'mass')": (
        "run 0 of `Cart` has unknown channel `z`; valid names:"
    ),
    "jj.identification.log_likelihood(cart, 3)": (
        "`data` is an int, expected an `Experiment` or a sequence of at least one"
    ),
    "jj.identification.log_likelihood(cart, run(), rtol=-1.0)": (
        "`rtol` is -1, expected a positive finite number"
    ),
}

SENSORS: dict[str, str] = {
    "jj.identification.Sensor(3)": "`quantity` of `Sensor` is an int, expected a coordinate, a speed",
    "jj.identification.Sensor(lag=-0.1)": "`lag` of `Sensor` is -0.1 s, expected zero or more",
    "jj.identification.Sensor(delay=-0.1)": (
        "`delay` of `Sensor` is -0.1 s, expected zero or more; if the clock of a channel is ahead, shift"
        " its times"
    ),
    "jj.identification.Sensor(gain=np.nan)": "`gain` of `Sensor` is nan, expected a finite number",
    "jj.identification.Sensor(gain='one')": (
        "`gain` of `Sensor` is the text 'one', expected real numbers; give a number, or an `Estimate`"
    ),
    "jj.identification.Sensor(lag=[0.1, 0.2])": "`lag` of `Sensor` has shape (2,), expected one number",
    "jj.identification.Sensor(gain=jj.Estimate())": (
        "`gain` of `Sensor` is to be estimated, but has no first guess; give one: `jj.Estimate(1.0)`"
    ),
    "jj.identification.Sensor(delay=jj.Estimate(0.1))": (
        "`delay` of `Sensor` is to be estimated, but has no upper limit; give `range=jj.bounds"
    ),
    "jj.identification.Sensor(delay=jj.Estimate(0.1, range=jj.bounds(-1.0, 1.0)))": (
        "`delay` of `Sensor` may fall to -1 s, expected a range that begins at zero"
    ),
    "jj.identification.Sensor(lag=jj.Estimate((0.1, 0.2)))": (
        "`lag` of `Sensor` has 2 guesses, expected one number"
    ),
    "jj.Estimate(np.inf)": "`guess` of `Estimate` is inf, expected a finite number",
    "jj.Estimate(1.0, range=(0.0, 1.0))": "`range` of `Estimate` is a tuple, expected `bounds",
    "jj.Estimate(1.0, per_run=1)": "`per_run` of `Estimate` is an int, expected True or False",
    "jj.Estimate(1.0, prior=0.1)": (
        "`prior` of `Estimate` is a float, expected `jj.studies.Normal(mean, sigma)`"
    ),
    "jj.Estimate(1.0, prior=jj.studies.Normal(1.0, 0.0))": (
        "expected a standard deviation above zero; give known numbers without `Estimate`"
    ),
    "jj.identification.Actuator(1.0)": "`command` of `Actuator` is a float, expected `jj.Sampled",
    "jj.identification.Actuator(command, hold=1)": "`hold` of `Actuator` is an int ... expected True",
    "jj.identification.Actuator(command, gain=[1.0, 2.0])": (
        "`gain` of `Actuator` has shape (2,), expected one number"
    ),
    "jj.Experiment(TS, {'x': TS}, 1.0, start={}, sensors={'y': 'x'})": (
        "sensor `y` has no measured values; valid names: `x`"
    ),
    (
        "jj.fit(cart, jj.Experiment(TS, {'gyro': TS}, 1.0, start={'x': 0.0}, sensors={'gyro': 'x_rte'}), "
        "'mass')"
    ): (
        "run 0 of `Cart` has channel `gyro`, whose sensor measures an unknown quantity `x_rte`; did you mean"
        " `x_rate`"
    ),
    "fitted(delay=0.3)": (
        "`gyro` of run 0 of `Cart` starts at 0.2 s, with a delay of up to 0.3 s: its first samples refer"
        " to times before t0 = 0 s"
    ),
    "fitted(delay=jj.Estimate(0.1, range=jj.bounds(0.0, 0.5)))": (
        "give an earlier `t0` and its start, or NaN for these samples"
    ),
    "fitted(gain=jj.Estimate(3.0, range=jj.bounds(0.0, 2.0)))": (
        "first guess of `gyro.gain` is 3.0; expected a first guess between its bounds"
    ),
    "fitted(gain=[1.0, 2.0])": "`gain` of sensor `gyro` of run 0 of `Cart` has shape (2,), expected () or ()",
    "fitted(lag=jj.Estimate(0.0))": "first guess of `gyro.lag` is 0.0; expected a first guess above zero",
    "jj.fit(cart, [shown(gain=gain), shown(gain=jj.Estimate(2.0))], 'mass')": (
        "run 0 and run 1 share `gyro.gain` but define it differently ... ; give both the same, or"
        " `per_run=True`"
    ),
    "jj.identification.log_likelihood(cart, shown(gain=gain))": (
        "`gyro.gain` is to be estimated, but a likelihood needs its value"
    ),
    "with_input(jj.identification.Actuator(jj.Sampled([0.0, 1.0], [0.0, 1.0]), lag=0.1))": (
        "command of input `push` of run 0 of `Cart` ends at 1 s, before"
    ),
    "with_input(jj.Sampled([1.7e9, 1.7e9 + 4.0], [0.0, 1.0]))": (
        "is sampled from 1700000000 to 1700000004 s, but the run is from 0 to 4 s; take both from one clock"
    ),
    "jj.fit(cart, shown(), {'mass': jj.Estimate(per_run=True)})": (
        "`free` has a `mass` for each run, but all runs share the scene"
    ),
    "jj.fit(cart, shown(), {'mass': jj.Estimate((1.0, 2.0))})": (
        "first guess of `mass` has shape (2,), expected ()"
    ),
    (
        "jj.fit(cart, run(values={'push': TS}, sigma=1.0, sensors={'push': jj.identification.Sensor('x', "
        "gain=gain)}, inputs={'push': jj.identification.Actuator(command, gain=gain)}))"
    ): ("has a channel and an input `push`, both with an estimated gain; give the channel another name"),
}

NOISE: dict[str, str] = {
    "run(correlation_time={'y': 0.1})": "`correlation_time` names channel `y`, which has no values",
    "run(correlation_time=-0.1)": "the correlation time of channel `x` is -0.1 s, expected zero or more",
    "run(correlation_time=np.inf)": "the correlation time of channel `x` is inf s",
    "run(correlation_time=np.ones(21))": "correlation time of channel `x`",
    "jj.fit(cart, [run(correlation_time=None), run(correlation_time=0.1)], 'mass')": (
        "correlation time of channel `x` is None in one run and given in another"
    ),
    "jj.fit(cart, run(correlation_time=0.1), 'mass', loss=jj.identification.huber())": (
        "a robust loss assumes independent samples"
    ),
    "jj.identification.log_likelihood(cart, run(correlation_time=None))": (
        "the correlation time of channel `x` is None, but a likelihood needs it"
    ),
}

PRIORS: dict[str, str] = {
    "jj.identification.joint_normal({}, [[1.0]])": "expected a dictionary of name -> mean",
    "jj.identification.joint_normal({'a': 1.0}, [1.0])": "has shape (1,), expected (1, 1)",
    "jj.identification.joint_normal({'a': 1.0}, [[np.nan]])": "must be finite",
    "jj.identification.joint_normal({'a': 1.0, 'b': 1.0}, [[1.0, 0.0], [0.0, 0.0]])": (
        "the variance of `b` is 0, expected a number above zero"
    ),
    "jj.identification.joint_normal({'a': 1.0, 'b': 1.0}, [[1.0, 0.5], [0.4, 1.0]])": "is not symmetric",
    "jj.identification.joint_normal({'a': 1.0, 'b': 1.0}, [[1.0, 2.0], [2.0, 1.0]])": (
        "its correlation matrix has the negative eigenvalue -1"
    ),
    (
        "jj.fit(cart, jj.Experiment(TS, {'x': TS}, 0.01, start={'x': 0.3}, "
        "unknown_start={'x': together['mass']}, t0=0.0))"
    ): ("belongs to one run"),
}

DENSITIES: dict[str, str] = {
    "density.unconstrain({'dampin': 0.1})": "`dampin` is not among the unknowns; did you mean `damping`",
    "density.unconstrain({'damping': 2.0})": "`damping` is 2, which is at or beyond a bound",
    "density(jnp.zeros(3))": "the vector has shape (3,), expected (4,)",
    "density.whitened(jj.fit(cart, run(), 'mass'))": "give the fit of the same unknowns",
    "jj.identification.log_density(cart, [run(), run(correlation_time=None)], 'mass')": (
        "None in one run and given in another"
    ),
    "jj.identification.log_density(cart, [run(), run(sigma=None)], 'mass')": (
        "None in one run and given in another"
    ),
    "jj.identification.log_density(cart, run(sigma=None), 'damping', max_steps=3)": (
        "the motion fails at the first guess"
    ),
}

INERTIAS: dict[str, str] = {
    "jj.identification.log_cholesky([0.1, 0.1, 0.3])": (
        "no body of nonzero thickness has the principal moments"
    ),
    "jj.identification.log_cholesky([-0.1, 0.1, 0.1])": "no body of nonzero thickness",
    "jj.identification.log_cholesky([1.0, 2.0])": "has shape (2,), expected (3, 3) or (3,)",
    "jj.identification.log_cholesky(np.array([[1.0, 0.1, 0.0], [0.2, 1.0, 0.0], [0.0, 0.0, 1.0]]))": (
        "not symmetric; give Ixy = Iyx"
    ),
    (
        "jj.identification.log_cholesky(np.array([[1.0, 0.1, 0.0], [0.1, 1.0, 0.0], [0.0, 0.0, 1.0]]), "
        "symmetric=True)"
    ): ("Ixy = 0.1 and Iyz = 0"),
    "jj.identification.inertia_from_log_cholesky([1.0, 2.0, 3.0])": "has shape (3,), expected (6,), or (4,)",
}

TABLE = FITS | SENSORS | NOISE | PRIORS | DENSITIES | INERTIAS
