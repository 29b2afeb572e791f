"""Events after which a motion goes on: how exact motions and derivatives through them are, and how long they
take.

    python bench/contacts.py [--quick] [--json FILE]

Closed forms: t_10 of a ball that falls from 1 m and bounces, sqrt(2 h/g) (1 + 2 (e + ... + e^9)) with e =
0.7, and its derivatives; processor time; fits of 500 noisy throws; ends of slip of 1,000 bowling balls. A
`solve` is one motion without derivatives. `--quick`: fewer lanes. The JSON is a list of {"figure", "model",
"value", "required", "met"}.
"""

import jax
import jax.numpy as jnp
import numpy as np
from figures import figure, main, seconds_of
from small_scenes import Upright

import jourdain_jax as jj

NAME = "bouncing ball"
RIGHT = 2.47360446364125, 8.53571984478680, 41.2871353427762  # s, and by e


class Ball(Upright):
    """A ball above a floor, in a draught, so that eight numbers say how it moves."""

    bounce: float = jj.parameter(0.7, non_negative=True)
    gravity: float = jj.parameter(9.81)
    drag: float = jj.parameter(0.0)
    draught: float = jj.parameter(0.0)
    slope: float = jj.parameter(0.0)
    mass: float = jj.parameter(1.0, positive=True)

    def loads(self, motion):
        along = self.drag * (self.draught - motion.u.x_rate)
        return jj.gravity(motion, self.gravity), jj.generalized_force(motion, x_rate=along)

    def events(self, motion):
        jump = {"z_rate": -self.bounce * motion.u.z_rate}
        return {"floor": jj.Event(motion.q.z - self.slope * motion.q.x, jump=jump)}


def bounces(e, most=60, tolerance=1e-12):
    """Return the times of the bounces, as many as there may be."""
    options = {"rtol": tolerance, "atol": tolerance, "max_transitions": most}
    return jj.simulate(Ball(e), {"z": 1.0}, ts=[2.52], **options).phases.ts


def digits(quick):
    """Errors of the time of the tenth bounce and of its derivatives by e, and of the energy."""
    tenth = lambda e: bounces(e)[9]
    time, first, second = RIGHT
    off = max(abs(f(tenth)(0.7) - first) for f in (jax.grad, jax.jacfwd))
    yield figure("ten bounces, time: error", NAME, abs(tenth(0.7) - time), 1e-12)
    yield figure("ten bounces, d/de: error", NAME, off, 1e-10)
    yield figure("ten bounces, d2/de2: error", NAME, abs(jax.hessian(tenth)(0.7) - second), 1e-8)
    motion = jj.simulate(Ball(), {"z": 1.0}, t1=2.5, rtol=1e-12, atol=1e-12)
    balance = motion.energies().balance
    yield figure("energy audit, of the energy", NAME, np.ptp(balance) / 9.81, 1e-9)


def seconds(call, *arguments):
    """Return the shortest processor time of a warm call."""
    return min(seconds_of(lambda: call(*arguments))[1] for _ in range(8))


def times(quick):
    """Time of a lane with ten bounces and more, and of derivatives by eight numbers through twelve, in
    solves.
    """
    e = jnp.linspace(0.5, 0.7, 200 if quick else 1000)
    lanes = seconds(jax.jit(jax.vmap(lambda e: bounces(e, 10, 1e-6)[9])), e)
    yield figure("a lane with ten bounces, us", NAME, 1e6 * lanes / len(e), 5.0)

    def last(x):
        options = {"ts": [2.52], "rtol": 1e-8, "atol": 1e-8, "max_transitions": 60}
        motion = jj.simulate(Ball(*x[:6]), {"z": x[6], "x_rate": x[7]}, **options)
        return motion.phases.ts[11] + motion.q[-1, 0]

    at = jnp.array([0.7, 9.81, 0.1, 0.3, 0.02, 1.0, 1.0, 0.5])
    lanes = jnp.tile(at, (64, 1))
    solve = seconds(jax.jit(jax.vmap(last)), lanes)
    for name, derivative, required in (("forward", jax.jacfwd, 6.0), ("reverse", jax.grad, 8.0)):
        taken = seconds(jax.jit(jax.vmap(derivative(last))), lanes)
        what = f"gradient by 8 numbers through 12 events, {name}, solves"
        yield figure(what, NAME, taken / solve, required)


def fits(quick):
    """Share of 95 % intervals that hold the truth, of fits to noisy heights of a bouncing ball."""
    ts, repeats = jnp.linspace(0.0, 1.6, 81), 100 if quick else 500
    noise = 0.004 * jax.random.normal(jax.random.PRNGKey(0), (repeats, len(ts)))
    heights = jj.simulate(Ball(0.72), {"z": 1.0}, ts=ts)["z"] + noise
    throws = jj.Experiment(ts, {"z": heights}, 0.004, start={"z": 1.0})
    found = jj.fit_batch(Ball(0.7, 9.7), throws, free=("bounce", "gravity")).estimates
    for name, right in (("bounce", 0.72), ("gravity", 9.81)):
        held = (found[name].low <= right) & (right <= found[name].high)
        off, most = abs(np.mean(held) - 0.95), 0.02 + 2 * (0.95 * 0.05 / repeats) ** 0.5
        yield figure(f"share of intervals that hold `{name}`, off 0.95", NAME, off, most)


class Bowling(jj.Scene):
    """A bowling ball that slides on its lane."""

    friction: float = jj.parameter(0.12)
    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def bodies(self, t, q):
        at = {"position": [q.x, q.y, q.z], "orientation": jj.quaternion_to_matrix(q.attitude)}
        return {"ball": jj.RigidBody.ball(6.8, 0.108, **at)}

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def contacts(self, pose):
        return {"lane": jj.ball_contact(pose["ball"], 0.108, height="row", friction=self.friction)}


def slips(quick):
    """Balls that slide in two directions: how many come to roll, and when slip w0 ends against 2 |w0|/(7 mu
    g).
    """

    def slip(along, aside, spin):
        start = {"z": 0.108, "x_rate": along, "y_rate": aside, "attitude_omega_x": spin}
        motion = jj.simulate(Bowling(), start, ts=[6.0], rtol=1e-10, atol=1e-10)
        right = 2 * jnp.hypot(along, aside + 0.108 * spin) / (7 * 0.12 * 9.81)
        return motion.phase("lane")[0] == 1, jnp.abs(jnp.nanmax(motion.phases.ts) - right)

    speeds = np.random.default_rng(0).uniform([4.0, 0.05, -5.0], [9.0, 1.0, 5.0], (1000, 3))
    rolls, off = jax.jit(jax.vmap(slip))(*speeds.T)
    yield figure("share that comes to roll", "bowling ball", jnp.mean(rolls), least=1.0)
    yield figure("end of slip: error, s", "bowling ball", jnp.max(off), 1e-9)

    def end(numbers):
        start = {"z": 0.108, "x_rate": numbers[1], "y_rate": 0.7}
        motion = jj.simulate(Bowling(numbers[0]), start, ts=[6.0], rtol=1e-12, atol=1e-12)
        return jnp.stack([motion["x"][0], motion["y"][0]])

    def right(numbers):
        slip = jnp.stack([numbers[1], 0.7])
        duration = 2 * jnp.hypot(*slip) / (7 * numbers[0] * 9.81)
        return slip * (duration * (1 - 0.5 * 2 / 7) + 5 / 7 * (6.0 - duration))

    numbers = jnp.array([0.12, 8.0])
    off = jnp.max(jnp.abs(end(numbers) - right(numbers)))
    yield figure("x(6 s), y(6 s): error, m", "bowling ball", off, 1e-10)
    for name, derivative in (("forward", jax.jacfwd), ("reverse", jax.jacrev)):
        off = jnp.max(jnp.abs(derivative(end)(numbers) - jax.jacfwd(right)(numbers)))
        yield figure(f"d/dmu, d/dv0 of x, y: error, {name}", "bowling ball", off, 1e-8)


if __name__ == "__main__":
    main(__doc__, (digits, times, fits, slips))
