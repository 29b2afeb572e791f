"""Gradients of the sum of squares of the final coordinates by eight numbers: forward, reverse, finite differences; error relative to the largest entry.

`simulate` under `jit`, Dopri8, no stabilisation; `reverse` is the default adjoint. The steps of the differences go with the tolerance.
"""

import dataclasses
from collections.abc import Callable, Iterator

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from oracles import rolling_disc

import jourdain_jax as jj
from work_precision_cases import record as records
from work_precision_cases.measure import fastest
from work_precision_cases.ours import MAX_STEPS
from work_precision_cases.problem import Problem

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
# Parameters of the scene, then coordinates and speeds of the start; none of them moves the rest of the start off the constraints.
BY = {
    "tilting-disc": (("mass", "radius", "gravity"), ("yaw", "lean", "yaw_rate", "lean_rate", "spin_rate")),
    "whipple-bicycle": (("mB", "zB", "IBxx", "IBzz", "mH", "c", "lam"), ("lean_rate",)),
}


def values(problem: Problem) -> np.ndarray:
    """The eight numbers of the problem."""
    parameters, named = BY[problem.name]
    at_start = dict(zip(problem.minimal_names, problem.minimal_start, strict=True))
    return np.array([*(float(getattr(problem.scene, name)) for name in parameters), *(at_start[name] for name in named)])


def loss(problem: Problem, adjoint) -> Callable:
    """`(tolerance, x) -> sum of squares of the final coordinates`, of the eight numbers x."""
    scene, state = problem.scene, problem.state
    parameters, named = BY[problem.name]
    q_names, u_names = scene.coordinate_names.entries, scene.speed_names.entries

    def value(tolerance, x):
        own = scene.replace(**dict(zip(parameters, x, strict=False)))
        q, u = state.q, state.u
        for name, number in zip(named, x[len(parameters) :], strict=True):
            q = q.at[q_names.index(name)].set(number) if name in q_names else q
            u = u.at[u_names.index(name)].set(number) if name in u_names else u
        if problem.name == "tilting-disc":  # the contact point moves with the spin along the heading
            forward, yaw = own.radius * u[u_names.index("spin_rate")], q[q_names.index("yaw")]
            u = u.at[0].set(forward * jnp.cos(yaw)).at[1].set(forward * jnp.sin(yaw))
        motion = jj.simulate(
            own,
            dataclasses.replace(state, q=q, u=u),
            ts=jnp.array([problem.end]),
            rtol=tolerance,
            atol=tolerance,
            solver=diffrax.Dopri8(),
            events=False,
            formulation=jj.Formulation(stabilisation=None),  # the start stays on the constraints
            adjoint=adjoint,
            max_steps=MAX_STEPS // 10,
        )
        return jnp.sum(motion.q_end**2)

    return value


def ways(problem: Problem) -> dict[str, Callable]:
    """Functions `(tolerance, x) -> gradient`, and the solve alone."""
    forward, reverse = loss(problem, diffrax.ForwardMode()), loss(problem, diffrax.RecursiveCheckpointAdjoint())

    def by_forward(tolerance, x):
        def along(v):
            return jax.jvp(lambda x: forward(tolerance, x), (x,), (v,))[1]

        # side by side the eight directions share the motion, but the bicycle's then take minutes to compile
        return jax.lax.map(along, jnp.eye(len(x))) if problem.large else jax.vmap(along)(jnp.eye(len(x)))

    def by_differences(tolerance, x):
        # the step at which truncation, step^2, balances the error of the motion over the step
        steps = jnp.maximum(tolerance, 1e-15) ** (1 / 3) * jnp.maximum(jnp.abs(x), 0.1)
        at = jnp.concatenate([x + jnp.diag(steps), x - jnp.diag(steps)])
        ups, downs = jnp.split(jax.lax.map(lambda x: forward(tolerance, x), at), 2)
        return (ups - downs) / (2 * steps)

    return {
        "solve alone": lambda tolerance, x: forward(tolerance, x)[None],
        "forward mode": by_forward,
        "central differences": by_differences,
        "reverse mode": lambda tolerance, x: jax.grad(lambda x: reverse(tolerance, x))(x),
    }


def of_disc_by_oracle(problem: Problem) -> np.ndarray:
    """The disc's gradient from Appell's equations in extended precision: central differences, extrapolated once; the mass does not matter."""
    names = ("radius", "gravity", "yaw", "lean", "yaw_rate", "lean_rate", "spin_rate")

    def value(name, change):
        run = rolling_disc.RUN | {name: rolling_disc.RUN[name] + change}
        found = rolling_disc.motion_yaw_lean_spin([0.0, problem.end], **run)
        return sum(float(found[key][-1]) ** 2 for key in ("x", "y", "yaw", "lean", "spin"))

    def slope(name, step=2e-4):
        wide, narrow = ((value(name, h) - value(name, -h)) / (2 * h) for h in (step, step / 2))
        return (4 * narrow - wide) / 3

    return np.array([0.0, *map(slope, names)])


def by_extrapolation(value: Callable, x) -> np.ndarray:
    """Central differences of `value(tolerance, x)`, extrapolated once."""

    def slope(i, step):
        away = jnp.zeros_like(x).at[i].set(step * max(abs(float(x[i])), 0.1))
        ups, downs = (float(value(jnp.asarray(1e-13), x + sign * away)[0]) for sign in (1, -1))
        return (ups - downs) / (2 * float(away[i]))

    return np.array([(4 * slope(i, 5e-4) - slope(i, 1e-3)) / 3 for i in range(len(x))])


def relative(found, expected) -> float:
    """The largest difference over the largest entry."""
    return float(np.max(np.abs(np.asarray(found) - expected)) / np.max(np.abs(expected)))


def measured(problem: Problem, say: Callable[[str], None], quick: bool = False) -> Iterator[dict]:
    """Records of a problem, and one that says what the reference is."""
    x = jnp.asarray(values(problem))
    chosen = ways(problem)
    if quick or problem.large:
        say("  reverse mode: left out, it takes long to compile")
        del chosen["reverse mode"]
    compiled = {name: jax.jit(way) for name, way in chosen.items()}
    expected = np.asarray(compiled["forward mode"](jnp.asarray(1e-13), x))
    if problem.name == "tilting-disc":
        against, other = "central differences of Appell's equations in extended precision, extrapolated once", of_disc_by_oracle(problem)
    else:
        against, other = "central differences at 1e-13, extrapolated once", by_extrapolation(compiled["solve alone"], x)
    uncertainty = relative(other, expected)
    say(f"  gradient: forward mode at 1e-13, {uncertainty:.1e} from {against}")
    yield {"reference": f"gradient, {problem.name}", "how": "forward mode, Dopri8 at 1e-13", "against": against, "uncertainty": uncertainty}
    for name, way in compiled.items():
        for tolerance in TOLERANCES[1:4] if quick else TOLERANCES:
            at = jnp.asarray(tolerance)
            found = jax.block_until_ready(way(at, x))
            error = None if name == "solve alone" else relative(found, expected)
            seconds = fastest(lambda way=way, at=at: jax.block_until_ready(way(at, x)))
            say(f"  {name:22s} {tolerance:8.1e}  relative error {'-' if error is None else format(error, '.1e'):>9}  {1e3 * seconds:10.4f} ms")
            yield records.record(
                problem=problem.name, method=name, kind=records.GRADIENT, setting=tolerance, setting_unit="tolerance", batch=1, error=error, seconds=seconds,
                note="error relative to the largest entry of the gradient; not projected", versions=records.versions("jax", "jaxlib", "diffrax"),
            )  # fmt: skip
