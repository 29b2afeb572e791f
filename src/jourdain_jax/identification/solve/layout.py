"""The layout of a vector of unknowns, and the scene, starts and sensors for such a vector.

Shared unknowns are parameters of the scene, second moments and shears of bodies (`body_inertia`), and numbers
of sensors. Other parameters may depend on them (`ties`).

The inertia of one body, in a scene with a parameter for each moment of inertia, is expressed by second
moments that are not negative:

    I_ij = c_k p_k                                    every entry of the body's inertia matrix is a parameter p_k, times a constant c_k, or zero
    I = tr(S) 1 - S,   S = L diag(D) L',   D >= 0     S: second moments of the mass about its centre;    L = [1 l12 l13; 0 1 l23; 0 0 1]

Exactly the possible inertias have this form. I is linear in D, so that a flat body, with a zero D, is at an
ordinary bound. Moments of inertia about two axes with one parameter are equal, and so are the two D. These
parameters are found by differentiating the inertia matrix.

Ties, parameters that depend on others in a fit (two equal wheels, an inertia given by a shape and a mass):

    p = f(scene)      f: plain JAX, of the scene with the unknowns and the parameters tied before

A function is traced when it is passed, and ties are compared by their computation: a new lambda in every call
is the same tie.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Entries, Indices, Shape, all_finite, described, largest, real_type
from jourdain_jax.equations.kinematics import pose_at
from jourdain_jax.program.calls import Call
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.names import Labels, check_name
from jourdain_jax.scene.parameter_fields import parameters_of
from jourdain_jax.scene.scene import Scene

_DIAGONAL, _PRODUCTS = ((0, 0), (1, 1), (2, 2)), ((0, 1), (1, 2), (0, 2))
_OTHERWISE = (
    "give each parameter its own range or tie, or make its inertia of `jj.identification.log_cholesky`"
    " numbers in the scene"
)


@dataclass(frozen=True)
class PossibleInertia:
    """Marker returned by `possible_inertia`."""


def possible_inertia() -> PossibleInertia:
    """Return a marker that frees the inertia of a body, restricted to possible values: `free={"rear frame":
    jj.identification.possible_inertia()}`, with the name of the body.

        I = tr(S) 1 - S,   S = L diag(D) L',   D >= 0,   L = [1 l12 l13; 0 1 l23; 0 0 1]

    Instead of the moments and products of inertia (kg m^2, about the mass centre) the fit has second moments
    D (kg m^2) and shears l as unknowns, `"rear frame second moment[0]"` and `"rear frame shear[0]"`.
    Principal moments of inertia are then positive, and each is at most the sum of the other two. `Fit.tied`
    has moments and products with standard errors and intervals to first order, except for a flat body, with D
    at its bound. Two axes that share one parameter, as for a wheel, share one D.

    The scene must have a parameter for each of the three moments, and for none, one or all of the products.
    Otherwise, or if no body of nonzero thickness has the inertia of the first guess, `fit` raises ValueError.
    Source: P. M. Wensing, S. Kim and J.-J. E. Slotine, IEEE Robotics and Automation Letters 3 (2018) 60, for
    possible inertias.
    """
    return PossibleInertia()


@dataclass(frozen=True)
class Entry:
    """A parameter that equals an entry of an inertia matrix up to a constant factor."""

    name: str
    index: Indices  # in the parameter, if it is an array
    row: int
    column: int
    factor: float  # entry = factor * parameter


@dataclass(frozen=True)
class BodyInertia:
    """The parameters of a scene that are the inertia of a body; hashable."""

    body: str
    entries: tuple[Entry, ...]  # the first entry of each parameter
    axes: Indices  # index of D for each axis
    products: Indices  # indices of the existing l12, l23, l13

    @property
    def labels(self) -> tuple[str, str]:
        """Return names of the entries of D and of l."""
        return f"{self.body} second moment", f"{self.body} shear"

    def numbers(self, scene: Scene) -> tuple[Float[Array, "moments"], Float[Array, "shears"]]:
        """Return D and l for a scene's parameters; NaN if no body of nonzero thickness has such moments."""
        value = {
            (entry.row, entry.column): entry.factor * getattr(scene, entry.name)[entry.index]
            for entry in self.entries
        }
        of_axis = {
            self.axes[entry.row]: value[entry.row, entry.row]
            for entry in self.entries
            if entry.row == entry.column
        }
        I = jnp.diag(jnp.stack([of_axis[k] for k in self.axes]))
        for i, j in (_PRODUCTS[k] for k in self.products):
            I = I.at[i, j].set(value[i, j]).at[j, i].set(value[i, j])
        S = jnp.trace(I) / 2 * jnp.eye(3, dtype=I.dtype) - I
        # L diag(D)^1/2 is upper triangular: the lower factor of S with reversed rows and columns, reversed
        # back
        A = jnp.linalg.cholesky(S[::-1, ::-1])[::-1, ::-1]
        D = jnp.diag(A) ** 2
        l = [A[i, j] / A[j, j] for i, j in (_PRODUCTS[k] for k in self.products)]
        return D[np.array([self.axes.index(k) for k in range(max(self.axes) + 1)])], (
            jnp.stack(l) if l else jnp.zeros(0, D.dtype)
        )

    def values(
        self, D: Float[Entries, "*members moments"], l: Float[Entries, "*members shears"]
    ) -> list[Float[Array, "*members"]]:
        """Return the parameter of every entry."""

        def inertia(D, l):
            L = jnp.eye(3, dtype=D.dtype)
            for k, product in enumerate(self.products):
                L = L.at[_PRODUCTS[product]].set(l[k])
            S = L @ jnp.diag(D[np.array(self.axes)]) @ L.T
            return jnp.trace(S) * jnp.eye(3, dtype=S.dtype) - S

        for _ in D.shape[:-1]:
            inertia = jax.vmap(inertia)
        I = inertia(jnp.asarray(D), jnp.asarray(l))
        return [I[..., entry.row, entry.column] / entry.factor for entry in self.entries]


def inertia_of_body(scene: Scene, name: str) -> BodyInertia:
    """Return the parameters of the named body's inertia. Raises ValueError if there is no such body, or if
    its inertia has another form.
    """
    diagonal, products = _found(scene, name)
    axes: list[int] = []
    entries: list[Entry] = []
    seen: dict[tuple, tuple[int, float]] = {}
    for i, entry in enumerate(diagonal):
        what = entry.name, entry.index
        if what not in seen:
            seen[what] = len(seen), entry.factor
            entries.append(entry)
        number, factor = seen[what]
        if factor != entry.factor:
            raise ValueError(
                _refusal(
                    scene,
                    name,
                    f"moments about axes {entries[number].row + 1} and "
                    f"{i + 1} are different multiples of `{entry.name}`",
                )
            )
        axes.append(number)
    there = tuple(k for k, entry in enumerate(products) if entry is not None)
    entries += [entry for entry in products if entry is not None]
    if len({(entry.name, entry.index) for entry in entries}) < len(entries):
        raise ValueError(
            _refusal(scene, name, "one parameter serves as a moment and a product, or as two products")
        )
    if len(there) == 2 or (there and len(seen) < 3):
        what = (
            f"it has {len(there)} products of inertia and {len(seen)} moments that differ, expected no, one"
            " or three products, and three moments with any"
        )
        raise ValueError(_refusal(scene, name, what))
    found = BodyInertia(name, tuple(entries), tuple(axes), there)
    if not all_finite(found.numbers(scene)[0]):
        moments = ", ".join(
            f"{entry.factor * float(np.asarray(getattr(scene, entry.name))[entry.index]):.4g}"
            for entry in diagonal
        )
        raise ValueError(
            f"no body of nonzero thickness has the moments of inertia of body `{name}` of "
            f"`{type(scene).__name__}`, {moments} kg m^2 with its products: principal ones must be positive, "
            "each less than the sum of the other two; for a flat body, reduce the largest slightly"
        )
    return found


def _found(scene: Scene, name: str) -> tuple[list[Entry], list[Entry | None]]:
    """Return entries of the diagonal, and of the products 12, 23, 13."""
    known = {of: placed.body for of, placed in pose_at(scene, 0.0, scene.named()[0]).bodies.items()}
    what = f"`free` asks for a possible inertia of `{name}`, which is not a body of `{type(scene).__name__}`"
    check_name(name, known, what)
    if not isinstance(known[name], RigidBody):
        raise ValueError(
            f"`free` asks for a possible inertia of `{name}`, but `{name}` is a particle; name a rigid body"
        )
    names = [
        of for of, value, _ in parameters_of(scene) if np.issubdtype(np.asarray(value).dtype, np.floating)
    ]
    values = {of: np.asarray(getattr(scene, of), float) for of in names}
    generator = np.random.default_rng(0)
    elsewhere = {
        of: x * (1 + 0.1 * generator.uniform(size=x.shape)) + 0.01 * generator.uniform(size=x.shape)
        for of, x in values.items()
    }
    slopes_of = _slopes(name)
    (I, slopes), (I_there, slopes_there) = slopes_of(scene, values), slopes_of(scene, elsewhere)
    size, round_off = largest(I), 1e-9

    def entry(i: int, j: int) -> Entry | None:
        where = [
            (of, index)
            for of in names
            for index in np.ndindex(values[of].shape)
            if slopes[of][(i, j, *index)] or slopes_there[of][(i, j, *index)]
        ]
        if not where:
            if i != j and abs(I[i, j]) <= round_off * size:
                return None
            raise ValueError(
                _refusal(
                    scene,
                    name,
                    f"entry {i + 1}{j + 1} of its inertia, {I[i, j]:.4g} kg m^2, is not a parameter",
                )
            )
        of, index = where[0]
        factor = float(slopes[of][(i, j, *index)])
        straight = all(
            abs(M[i, j] - factor * x[of][index]) <= round_off * abs(M[i, j])
            for M, x in ((I, values), (I_there, elsewhere))
        )
        if len(where) > 1 or not straight:
            parts = ", ".join(f"`{of}`" for of in dict.fromkeys(of for of, _ in where))
            raise ValueError(
                _refusal(
                    scene,
                    name,
                    f"entry {i + 1}{j + 1} of its inertia is made of {parts}, "
                    "expected one parameter times a constant",
                )
            )
        return Entry(of, index, i, j, factor)

    return [entry(i, j) for i, j in _DIAGONAL], [entry(i, j) for i, j in _PRODUCTS]


def _slopes(name: str) -> Callable:
    @eval_numpy
    def of(scene: Scene, values: dict):
        def inertia(values):
            moved = scene.replace(**values)
            return pose_at(moved, 0.0, moved.named()[0]).bodies[name].body.inertia

        return inertia(values), jax.jacfwd(inertia)(values)

    return of


def _refusal(scene: Scene, name: str, why: str) -> str:
    return (
        f"the inertia of body `{name}` of `{type(scene).__name__}` cannot be given by `possible_inertia`:"
        f" {why}; {_OTHERWISE}"
    )


@dataclass(frozen=True)
class Tie:
    """A parameter, and its dependence on the leaves of the scene."""

    name: str
    function: Call

    def value(self, leaves: list) -> Array:
        """Return the parameter of a scene with these leaves."""
        return self.function.results(*leaves)[0]


def tied_by(name: str, function: Callable, scene: Scene) -> Tie:
    """Return a parameter as a function of the scene, which has the first guesses. Raises ValueError unless
    the function returns an allowed value.
    """
    leaves, treedef = jax.tree.flatten(scene)
    expected = jnp.shape(getattr(scene, name))

    def of_leaves(*leaves):
        value = function(jax.tree.unflatten(treedef, leaves))
        try:
            found = jnp.asarray(value, real_type())
        except (TypeError, ValueError):
            raise ValueError(
                f"the function in `free` of `{name}` returns {described(value)}, expected a "
                f"number or an array of shape {expected}"
            ) from None
        if found.shape != expected:
            raise ValueError(
                f"the function in `free` of `{name}` returns an array of shape {found.shape}, "
                f"expected {expected}, the shape of the parameter"
            )
        return found

    found = Tie(name, Call(jax.make_jaxpr(of_leaves)(*leaves), ("a tied parameter",)))
    try:
        scene.replace(**{name: found.value(leaves)})
    except ValueError as error:
        raise ValueError(
            f"at the first guess the function in `free` of `{name}` gives a value that is not "
            f"allowed: {error}"
        ) from None
    return found


# parameter; inertia of a body; initial value; number of a sensor or an actuator
Kind = Literal["scene", "inertia", "start", "sensor"]


@dataclass(frozen=True)
class Place:
    """Location of the entries of a parameter, an initial value, or a number of a sensor or actuator, in a
    vector of unknowns.
    """

    name: str  # for a sensor or actuator: "gyro.gain"
    shape: Shape
    begin: int
    kind: Kind

    @property
    def end(self) -> int:
        """Return the end of the range."""
        return self.begin + math.prod(self.shape)

    def of(self, vector):
        """Return the numbers of this entry from a vector (or from many, with leading axes), in their own
        shape.
        """
        return vector[..., self.begin : self.end].reshape((*vector.shape[:-1], *self.shape))


@dataclass(frozen=True)
class Layout:
    """Names and shapes of the shared unknowns and of the unknowns of each run, and the dependent parameters;
    hashable.

    A single run has only shared unknowns, unless it is cut into pieces.
    """

    shared: tuple[Place, ...]
    local: tuple[Place, ...]
    bodies: tuple[BodyInertia, ...] = ()
    ties: tuple[Tie, ...] = ()

    @property
    def sizes(self) -> tuple[int, int]:
        """Return the numbers of shared unknowns, and of unknowns of each run."""
        return self.shared[-1].end if self.shared else 0, self.local[-1].end if self.local else 0

    @property
    def parameters(self) -> set[str]:
        """Return names of the parameters that differ from the scene's."""
        return {place.name for place in self.shared if place.kind == "scene"} | set(self.following)

    @property
    def following(self) -> Labels:
        """Return names of the dependent parameters: moments of inertia of bodies, and tied ones."""
        return tuple(
            dict.fromkeys(
                [
                    *(entry.name for body in self.bodies for entry in body.entries),
                    *(tie.name for tie in self.ties),
                ]
            )
        )

    def scene(self, scene: Scene, shared: Float[Entries, "*members shared"]) -> Scene:
        """Return the scene with these shared unknowns."""
        leaves, treedef = jax.tree.flatten(scene)
        # with the index of each parameter's leaf
        found, names = list(leaves), jax.tree.unflatten(treedef, range(treedef.num_leaves))
        for place in self.shared:
            if place.kind == "scene":
                found[getattr(names, place.name)] = place.of(shared)
        of_bodies = {place.name: place.of(shared) for place in self.shared if place.kind == "inertia"}
        for body in self.bodies:
            for entry, value in zip(body.entries, body.values(*map(of_bodies.get, body.labels)), strict=True):
                leaf = getattr(names, entry.name)
                own = jnp.broadcast_to(found[leaf], value.shape + jnp.shape(leaves[leaf]))
                found[leaf] = own.at[(..., *entry.index)].set(value)
        for tie in self.ties:
            # parameters of members have leading axes, shared ones have none
            function, axes = (
                tie.value,
                [0 if np.ndim(x) > np.ndim(own) else None for x, own in zip(found, leaves, strict=True)],
            )
            for _ in shared.shape[:-1]:
                function = jax.vmap(function, in_axes=(axes,))
            found[getattr(names, tie.name)] = function(found)
        return jax.tree.unflatten(
            treedef, [x if x is own else jnp.asarray(x) for x, own in zip(found, leaves, strict=True)]
        )

    def start(self, start: dict, *vectors: Float[Entries, "*members _"]) -> dict:
        """Return the start of a run for these shared unknowns and its own."""
        return start | {name: x for name, x in self._of_kind("start", vectors) if name in start}

    @property
    def numbers(self) -> bool:
        """Return whether sensors or actuators have unknown numbers."""
        return any(place.kind == "sensor" for place in (*self.shared, *self.local))

    def known(self, *vectors) -> dict[str, Array | np.ndarray]:
        """Return numbers of sensors and actuators by name, of one run."""
        return dict(self._of_kind("sensor", vectors))

    def _of_kind(self, kind: Kind, vectors) -> Iterator:
        """Return names of the unknowns of a kind, with their values in the vectors of shared unknowns and of
        a run.
        """
        return (
            (place.name, place.of(x))
            for places, x in zip((self.shared, self.local), vectors, strict=True)
            for place in places
            if place.kind == kind
        )
