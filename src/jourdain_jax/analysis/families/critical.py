"""Compute special points of steady motions as functions of the parameters p, by the implicit function
theorem.

    G(X, p) = 0,   dX = -G_X+ G_p dp,   X = (z, a, b, w)
    G = ( R,  C a,  C b,  size and phase of a and b,  and one of: )

    pair on the imaginary axis   F a = -w b,  F b = w a
    double root                  F a = w a,  F b = w b + a
    zero eigenvalue              F a = 0,  F b = 0, with b along the steady motions that continue at the same
                                 parameters

R, F, C, z: as in `equations.py`; a, b: vectors of small motions; w: a frequency or an eigenvalue. One scalar
program computes R, F x and C x; eigenvalue derivatives use it, too. G has redundant but consistent rows. G_X
has full column rank; its pseudo-inverse is computed by Q R.
"""

from collections.abc import Callable
from functools import cached_property, partial
from itertools import combinations
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from jourdain_jax.analysis.families.equations import DOUBLE, PAIR, ZERO, SteadyEquations, null_space
from jourdain_jax.analysis.families.family import Family, FamilyPoint
from jourdain_jax.analysis.motion_derivatives import ByProgram, Sloped, node_values
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import Count, Flag, Indices, Scalar, largest, static
from jourdain_jax.integrate.state import State
from jourdain_jax.program.derivative import derivatives
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.printing import Printed, complex_numbers
from jourdain_jax.scene.scene import Scene


class SpecialProgram:
    """Program for R, F x and C x of one vector x, and their derivatives. Arguments are all numbers and x; the
    vectors a and b are a batch.
    """

    def __init__(self, scene: Scene, instant: ByProgram, of: tuple[Indices, ...]) -> None:
        graph, (rows, rates, states, of_states, places) = instant.graph, of
        x = [graph.input(f"special {k}", True) for k in range(len(states))]
        moved, at = [instant.v[k] for k in (*rates, *of_states)], [instant.columns[k] for k in states]
        nodes = [instant.v[k] for k in rows] + derivatives(graph, moved, dict(zip(at, x, strict=True)))
        given, unknowns = [*instant.given, *x], [*(instant.given[k] for k in places), *x]
        self.values = node_values(graph, nodes, given)
        self.pulled = jax.jit(lambda at, w: jax.vjp(self.values, at)[1](w)[0])
        self.sloped = lambda: Sloped(graph, nodes, unknowns, given, instant.guards)

    @cached_property
    def of(self) -> Sloped:
        """Return the function that computes R, F x, C x and their derivatives with respect to z and x."""
        return self.sloped()


def program_of(equations: SteadyEquations) -> SpecialProgram:
    of = equations.rows, equations.rates, equations.states, equations.of_states, equations.places
    return _kept_program(equations.scene, equations.instant, tuple(tuple(part.tolist()) for part in of))


_kept_program = once_per_class(SpecialProgram)


Unknowns = Float[Array, "all_unknowns"]

FOUND, NOT_FOUND, SINGULAR = range(3)
MEANINGS = (
    "found",
    "not found: the point of the family cannot be followed to these parameters",
    "not a smooth function of the parameters here: eigenvalues or special points coincide",
)


class CriticalPoint(Printed, eqx.Module):
    """Special point of a family: `point["lean"]`, `point.speed`. All numbers are NaN unless `code` is 0."""

    state: State
    parameters: dict[str, Float[Array, "*batch"]]  # the parameters that vary along the family
    eigenvalue: Complex[Array, "*batch"]  # 1/s; on the imaginary axis, or double
    # smallest pivot of the equations divided by the largest; near zero, special points are close together
    condition: Float[Array, "*batch"]
    code: Int[Array, "*batch"]
    kind: str = static()

    def __getitem__(self, name: str) -> Float[Array, "*batch"]:
        """Return a coordinate, a speed, or the parameter that varies."""
        return self.parameters[name] if name in self.parameters else self.state[name]

    @property
    def speed(self) -> Float[Array, "*batch"]:
        """Return the speed of the point (x, y) of the scene, m/s."""
        return jnp.sqrt(self.state["x_rate"] ** 2 + self.state["y_rate"] ** 2)

    @property
    def message(self) -> str:
        """Return the explanation of the code."""
        return MEANINGS[int(self.code)]

    def _text(self) -> str:
        if self.code.ndim:
            return f"{self.kind}: {int((self.code == FOUND).sum())} of {self.code.size} found"
        varied = "".join(f", {name} = {value:.6g}" for name, value in self.parameters.items())
        return (
            f"{self.kind}{varied}: {self.message}; eigenvalue {complex_numbers(self.eigenvalue[None])[0]}"
            f" 1/s\n{self.state}"
        )


class Special(eqx.Module):
    """Equations of a special point, and its values X in the family, from which it is followed as parameters
    change.
    """

    equations: SteadyEquations = static()
    program: SpecialProgram = static()
    kind: str = static()
    X: Unknowns

    def parts(self, X: Unknowns) -> list[Array]:
        """Split X into z, a, b and w."""
        n, m = len(self.equations.places), len(self.equations.states)
        return jnp.split(X, [n, n + m, n + 2 * m])

    def numbers(self, scene: Scene, X: Unknowns) -> Float[Array, "numbers"]:
        """Return parameters, t, q, u and inputs as one vector."""
        of = self.equations
        known = [*map(jnp.ravel, jax.tree.leaves(scene)), of.given[of.instant.states[0] - 1 :]]
        return jnp.concatenate(known).at[of.places].set(self.parts(X)[0] * of.size)

    def each(self, function: Callable, scene: Scene, X: Unknowns):
        """Return results of a function of all arguments of the program, for a and for b."""
        numbers = self.numbers(scene, X)
        return jax.vmap(lambda x: function(jnp.append(numbers, x)))(jnp.stack(self.parts(X)[1:3]))

    def equations_at(self, scene: Scene, X: Unknowns, near: Unknowns) -> Array:
        """Return the residual G of the equations."""
        return self.rows(X, near, self.each(self.program.values, scene, X))

    def rows(self, X: Unknowns, near: Unknowns, values: Float[Array, "2 values"]) -> Array:
        """Return the residual G from results of the program for a and for b. Size and phase of a and b are
        those of the point `near`, up to the second order.
        """
        (z, a, b, w), (_, a0, b0, _), of = self.parts(X), self.parts(near), self.equations
        R, F, C = jnp.split(values, [len(of.rows), len(of.rows) + len(of.states)], axis=1)
        F_a, F_b, chosen = {
            PAIR: (-w * b, w * a, [a0 @ (a - a0) + b0 @ (b - b0), a0 @ b - b0 @ a]),
            DOUBLE: (w * a, w * b + a, [a0 @ (a - a0), a0 @ b]),
            # b is zero unless steady motions continue at the same parameters
            ZERO: (0 * a, 0 * b, [a0 @ (a - a0), b0 @ a, a0 @ b, b0 @ (b - b0), w[0]]),
        }[self.kind]
        held = (z - self.parts(self.X)[0])[of.held]
        return jnp.concatenate([R[0], F[0] - F_a, F[1] - F_b, *C, held, jnp.stack(chosen)])

    def newton_step(self, scene: Scene, X: Unknowns, near: Unknowns) -> tuple[Array, Array, Array]:
        """Return the Gauss-Newton step, the pseudo-inverse of G_X, and the ratio of its smallest to its
        largest pivot.
        """
        values, D, _ = self.each(self.program.of, scene, X)

        def linear(dX):
            z, a, b, _ = self.parts(dX)
            along = [D_x @ jnp.append(z * self.equations.size, x) for D_x, x in zip(D, (a, b), strict=True)]
            return self.rows(X + dX, near, values + jnp.stack(along))

        G, slope = jax.linearize(linear, jnp.zeros_like(X))
        # the last column of the triangular factor is Q' G: where only the step is needed, XLA leaves Q out
        Q, T = jnp.linalg.qr(jnp.column_stack([jax.vmap(slope, out_axes=1)(jnp.eye(len(X))), G]))
        n = len(X)
        Q, T, rest = Q[:, :n], T[:n, :n], T[:n, n]
        pivots, solved = jnp.abs(jnp.diagonal(T)), partial(jax.scipy.linalg.solve_triangular, T)
        return solved(rest), solved(Q.T), jnp.min(pivots) / jnp.max(pivots)

    def point(self, scene: Scene, X: Unknowns, condition, code) -> CriticalPoint:
        """Return the point of a scene at X."""
        of, w, numbers = self.equations, self.parts(X)[-1][0], self.numbers(scene, X)
        varied = {name: numbers[of.by_name[name]] for name in of.vary}
        eigenvalue = jax.lax.complex(*((0 * w, w) if self.kind == PAIR else (w, 0 * w)))
        return CriticalPoint(of.state(numbers), varied, eigenvalue, condition, code, self.kind)


@compiled_quickly
def _solution(special: Special, scene: Scene, near: Unknowns, inverse, condition, code) -> CriticalPoint:
    """Return the special point of a scene from the results of `followed_to`. It is twice differentiable."""
    X = near
    for _ in range(2):  # each carries one order of derivatives
        X = X - inverse @ special.equations_at(scene, X, near)
    return special.point(scene, X, condition, code)


class _Followed(NamedTuple):
    """Point reached after a fraction `done` of the change of the parameters."""

    X: Unknowns
    done: Scalar
    step: Scalar  # the next share
    tries: Count
    found: Flag


@jax.custom_batching.custom_vmap
def followed_to(special: Special, scene: Scene) -> tuple[Array, Array, Array, Array]:
    """Return X, the pseudo-inverse of G_X, the ratio of its smallest to its largest pivot, and a code. X is
    NaN unless the code is 0.

    Parameters change linearly from the family's to the given ones, at first in a single step. Three
    corrections by Newton's method follow. The step is accepted if each correction is at most 0.3 of the
    previous one; otherwise it is shortened. Corrections that shrink this fast stay close to the start and do
    not lead to another point. The point is found if the next correction, at the rate of the last two, would
    be below 1e-7.
    """

    def once(at: _Followed) -> _Followed:
        share = jnp.minimum(at.done + at.step, 1.0)
        there = jax.tree.map(lambda a, b: a + share * (b - a), special.equations.scene, scene)

        def corrected(X, _):
            change, *_ = special.newton_step(there, X, at.X)
            return X - change, largest(change)

        X, (first, second, third) = jax.lax.scan(corrected, at.X, length=3)
        good = (first < 1) & (second <= 0.3 * first + 1e-9) & (third <= 0.3 * second + 1e-9)
        X, done = jnp.where(good, X, at.X), jnp.where(good, share, at.done)
        step = jnp.where(good, 2 * at.step, at.step / 4)
        return _Followed(X, done, step, at.tries + 1, good & (share == 1) & (third**2 <= 1e-7 * second))

    goes_on = lambda at: ~at.found & (at.step > 1e-3) & (at.tries < 100)
    start = _Followed(special.X, jnp.array(0.0), jnp.array(1.0), jnp.array(0), jnp.array(False))
    found = jax.lax.while_loop(goes_on, once, start)
    X = found.X - special.newton_step(scene, found.X, found.X)[0]
    change, inverse, condition = special.newton_step(scene, X, found.X)
    known = found.found & (largest(change) < 1e-8)
    code = jnp.where(known, jnp.where(condition < 1e-6, SINGULAR, FOUND), NOT_FOUND)
    return jnp.where(code == FOUND, X - change, jnp.nan), inverse, condition, code


@followed_to.def_vmap
def _in_blocks(count: int, of_samples: list, *batch):
    """Follow samples in small blocks, because their numbers of steps differ."""
    moving, fixed = eqx.partition([*batch], of_samples)
    # the last sample fills the last block, so that only whole blocks are compiled
    places = np.minimum(np.arange(count + -count % 8), count - 1)
    one = lambda moving: followed_to.fun(*eqx.combine(moving, fixed))
    found = jax.lax.map(one, jax.tree.map(lambda x: x[places], moving), batch_size=8)
    return jax.tree.map(lambda x: x[:count], found), jax.tree.map(lambda _: True, found)


# Without derivatives, JAX runs `followed_to` as a program of its own, which compiles quickly. The rule is
# never used.
_found = jax.custom_jvp(compiled_quickly(followed_to))
_found.defjvp(lambda *_: NotImplemented)


@shown_from_users_lines
def critical(scene: Scene | BuiltFor, motions: Family, what: "str | FamilyPoint") -> CriticalPoint:
    """Return a special point of a family as a function of the scene's parameters: a point where an eigenvalue
    crosses the imaginary axis, or where two eigenvalues coincide.

        straight = jj.family(bicycle, {"x_rate": 5.0, "rear_spin_rate": 16.7, "front_spin_rate": 14.3})
        jax.grad(lambda c: jj.critical(bicycle.replace(c=c), straight, "weave").speed)(0.08)

    **Arguments**

    - `scene`: a scene of the family's class. Its parameters may be traced and may differ from the family's;
      the point is followed from the family's parameters to the given ones.
    - `motions`: the family, whose inputs are used.
    - `what`: the name of a mode, a kind of point ("double root"), or one of the family's `changes`. If
      several points match, the one nearest to the family's guess is taken.

    **Returns** a `CriticalPoint`. It is twice differentiable, by the implicit function theorem, also under
    `jit` and `vmap`. If the point does not exist for these parameters, or is not a smooth function of them,
    its numbers and their derivatives are NaN, and `code` is not 0.

    **Raises** ValueError if the family has no such point, or only as a fold or branch point; if the scene is
    of another class; and in float32.
    """
    scene, equations = as_scene(scene), motions.equations
    if not isinstance(equations, SteadyEquations):
        raise ValueError(
            "`critical` needs a family of steady motions, but this is a family of periodic motions"
        )
    if type(scene) is not type(equations.scene):
        raise ValueError(
            f"the family belongs to `{type(equations.scene).__name__}`, but the scene is a "
            f"`{type(scene).__name__}`; pass a scene of the family's class"
        )
    with jax.ensure_compile_time_eval():
        special = special_at(equations, _chosen(motions, what))
    return _solution(special, scene, *_found(special, jax.lax.stop_gradient(scene)))


def _chosen(curve: Family, what: "str | FamilyPoint") -> FamilyPoint:
    """Return the point of the family selected by `what`."""
    known = {
        point: [point.kind, *(point.modes if point.kind != DOUBLE else ())]
        for point in curve.changes
        if point.kind in (PAIR, ZERO, DOUBLE)
    }
    found = [point for point, names in known.items() if what is point or what in names]
    if not found:
        names = ", ".join(sorted(set().union(*known.values())))
        raise ValueError(
            f"the family of `{type(curve.equations.scene).__name__}` has no such special point; "
            f"it has: {names or 'none'}"
        )
    start = curve.equations.start
    return min(found, key=lambda point: largest(curve.equations.place(point) - start))


def special_at(equations: SteadyEquations, point: FamilyPoint) -> Special:
    """Return the equations, with vectors a and b at the point of the family."""
    if not jax.config.jax_enable_x64:
        raise ValueError("critical points need float64; set jax.config.update('jax_enable_x64', True)")
    z, s = equations.place(point), point.eigenvalues
    look = equations(z)
    F, C = look.small
    E = null_space(C)
    A, w, b = E.T @ F @ E, 0.0, np.zeros(len(E))
    null = lambda M: np.linalg.svd(M)[2][-1].conj()
    freedoms = equations.freedoms(look)
    if point.kind == ZERO:
        if freedoms.shape[1] > 1:
            raise ValueError(
                f"the steady motions for these parameters form a set of {freedoms.shape[1]} dimensions, but "
                "`critical` follows a zero eigenvalue only on a curve; choose a point of another kind"
            )
        b = np.sum(freedoms, axis=1) / max(np.linalg.norm(freedoms), 1e-300)
        a = E @ null(np.vstack([A, b @ E]))
    elif point.kind == PAIR:
        w = min((x for x in s if x.imag > 0), key=lambda x: abs(x.real)).imag
        x = E @ null(A - 1j * w * np.eye(len(A)))
        a, b = x.real, x.imag
    else:
        w = np.mean(min(combinations(s, 2), key=lambda pair: abs(pair[0] - pair[1]))).real
        moved = A - w * np.eye(len(A))
        a = null(moved)
        a, b = E @ a, E @ np.linalg.lstsq(np.vstack([moved, a]), np.append(a, 0.0), rcond=None)[0]
    X = jnp.asarray(np.concatenate([z, a, b, [w]]))
    return Special(equations, program_of(equations), point.kind, X)
