"""The inertia of one body as unknowns of a fit: nonnegative second moments, and shears.

The scene has a parameter for each moment of inertia.

    I_ij = c_k p_k                      each entry is zero, or a parameter p_k times a constant c_k
    I = tr(S) 1 - S,   S = L diag(D) L',   D >= 0,   L = [1 l12 l13; 0 1 l23; 0 0 1]

I: inertia matrix; S: second moments of the mass about its centre. An inertia matrix has this form if and only
if a distribution of mass can have it. I is linear in D; a flat body has a zero D, which is an ordinary bound.
If two axes share one parameter, their moments of inertia are equal, and so are their D. The parameters p_k
are found by differentiating the inertia matrix.

A `Tie` makes a parameter depend on others in a fit, such as equal radii of two wheels:

    p = f(scene)      f: plain JAX, of the scene with the unknowns and all previously tied parameters

A function is traced when it is passed. Ties are compared by their operations, so that a new lambda in
every call is the same tie.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Entries, Indices, all_finite, described, largest, real_type
from jourdain_jax.equations.kinematics import pose_at
from jourdain_jax.program.calls import Call
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.coordinates import check_name, parameters_of
from jourdain_jax.scene.scene import Scene

_DIAGONAL, _PRODUCTS = ((0, 0), (1, 1), (2, 2)), ((0, 1), (1, 2), (0, 2))
_OTHERWISE = (
    "give each parameter its own range or tie, or make its inertia of `jj.identification.log_cholesky`"
    " numbers in the scene"
)


@dataclass(frozen=True)
class PossibleInertia:
    """Marker for a body with free inertia, returned by `possible_inertia`."""


def possible_inertia() -> PossibleInertia:
    """Return a marker that frees the inertia of a body, restricted to possible values: `free={"rear frame":
    jj.identification.possible_inertia()}`, with the name of the body.

        I = tr(S) 1 - S,   S = L diag(D) L',   D >= 0,   L = [1 l12 l13; 0 1 l23; 0 0 1]

    I: moments and products of inertia (kg m^2, about the mass centre). In their place, the fit has second
    moments D (kg m^2) and shears l as unknowns, such as `"rear frame second moment[0]"` and
    `"rear frame shear[0]"`. Principal moments of inertia are then positive, and each is at most the sum of
    the other two. `Fit.tied` has moments and products with standard errors and intervals to first order,
    except for a flat body, with D at its bound. Two axes that share one parameter, as for a wheel, share one
    D.

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
    """The parameters of a scene that make up the inertia of a body; hashable."""

    body: str
    entries: tuple[Entry, ...]  # the first entry of each parameter
    axes: Indices  # index of D for each axis
    products: Indices  # indices of the existing l12, l23, l13

    @property
    def labels(self) -> tuple[str, str]:
        """Return the names of the unknowns D and l."""
        return f"{self.body} second moment", f"{self.body} shear"

    def numbers(self, scene: Scene) -> tuple[Float[Array, "moments"], Float[Array, "shears"]]:
        """Return D and l for a scene's parameters, or NaN if no body of nonzero thickness has such
        moments.
        """
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
        # L diag(D)^1/2 is upper triangular: the lower Cholesky factor of S with reversed rows and columns,
        # reversed again
        A = jnp.linalg.cholesky(S[::-1, ::-1])[::-1, ::-1]
        D = jnp.diag(A) ** 2
        l = [A[i, j] / A[j, j] for i, j in (_PRODUCTS[k] for k in self.products)]
        return D[np.array([self.axes.index(k) for k in range(max(self.axes) + 1)])], (
            jnp.stack(l) if l else jnp.zeros(0, D.dtype)
        )

    def values(
        self, D: Float[Entries, "*members moments"], l: Float[Entries, "*members shears"]
    ) -> list[Float[Array, "*members"]]:
        """Return the parameter of every entry, for these D and l."""

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
    its inertia matrix is not built from parameters as `possible_inertia` requires.
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
            f"it has {len(there)} products of inertia and {len(seen)} different moments, expected no product,"
            " or one or three products with three different moments"
        )
        raise ValueError(_refusal(scene, name, what))
    found = BodyInertia(name, tuple(entries), tuple(axes), there)
    if not all_finite(found.numbers(scene)[0]):
        moments = ", ".join(
            f"{entry.factor * float(np.asarray(getattr(scene, entry.name))[entry.index]):.4g}"
            for entry in diagonal
        )
        raise ValueError(
            f"no body of nonzero thickness has the inertia of body `{name}` of `{type(scene).__name__}`, "
            f"with the moments {moments} kg m^2: principal moments must be positive, each less than the sum "
            "of the other two; for a flat body, reduce the largest slightly"
        )
    return found


def _found(scene: Scene, name: str) -> tuple[list[Entry], list[Entry | None]]:
    """Return the entries of the inertia matrix: its diagonal, and its products 12, 23, 13."""
    known = {of: placed.body for of, placed in pose_at(scene, 0.0, scene.named()[0]).bodies.items()}
    what = f"`free` has a possible inertia for `{name}`, which is not a body of `{type(scene).__name__}`"
    check_name(name, known, what)
    if not isinstance(known[name], RigidBody):
        raise ValueError(
            f"`free` has a possible inertia for `{name}`, but this is a particle; name a rigid body"
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
        """Return the tied parameter of a scene with these leaves."""
        return self.function.results(*leaves)[0]


def tied_by(name: str, function: Callable, scene: Scene) -> Tie:
    """Return the tie of a parameter by a function of the scene. Raises ValueError unless the function returns
    an allowed value at the first guesses in `scene`.
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
