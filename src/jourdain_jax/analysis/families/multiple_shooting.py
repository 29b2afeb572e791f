"""Equations of multiple shooting (R in `periodic.py`), with derivatives and multipliers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from jourdain_jax.analysis.families.equations import sizes
from jourdain_jax.analysis.motion_derivatives import ByMatrices, ByProgram, places_of
from jourdain_jax.calculus.matrices import null_space_svd
from jourdain_jax.calculus.reals import Indices, PerRow, PerTime, Scalar, static
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.integrate.inputs import Inputs, inputs_at
from jourdain_jax.integrate.state import state_of
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import structure_of
from jourdain_jax.structure.trace import event_values

Unknowns = Float[Array, "unknowns"]
States = Float[Array, "states"]


class Shooting(eqx.Module):
    """Equations of multiple shooting: the residual R and its derivatives as functions of the unknowns, which
    are the states at the starts of the pieces, shape (pieces, states), and the period.
    """

    scene: Scene
    t: Scalar  # s, at the start
    inputs: Inputs
    options: AllOptions
    shift: States  # given change per period
    instant: ByProgram | ByMatrices = static()
    pieces: int = static()
    until: int | None = static()  # index of the event c; None if the period is known
    kept: Indices = static()  # indices of the entries of z that must be periodic
    free: Indices = static()  # indices of the unknown entries of z at the start
    shifted: Labels = static()  # names of coordinates with a given shift

    @property
    def sizes(self) -> Float[np.ndarray, "states"]:
        """Return the sizes of coordinates and speeds."""
        return sizes(self.scene)

    @property
    def is_unknown(self) -> Bool[np.ndarray, "all_unknowns"]:
        """Return which entries of the states at the starts of the pieces, and of the period, are unknown."""
        at_start = [k in self.free for k in range(len(self.sizes))]
        return np.array([*at_start, *[True] * len(self.sizes) * (self.pieces - 1), self.until is not None])

    def split(self, z: States) -> tuple[Array, Array]:
        """Return q and u."""
        n = len(self.scene.coordinate_names.entries)
        return z[:n], z[n:]

    def motion(self, t0, z: States, ts: PerTime):
        """Return the motion from a state."""
        start = state_of(self.scene, t0, *self.split(z))
        return simulate(
            self.scene, start, t0=t0, ts=ts, inputs=self.inputs, options=self.options
        ).nan_if_failed()

    def moved(self, k, z: States, period) -> States:
        """Return f_k, the state at the end of piece k."""
        start, end = (self.t + i * period / self.pieces for i in (k, k + 1))
        motion = self.motion(start, z, end[None])
        return jnp.concatenate([motion.q_end, motion.u_end])

    def events(self, t, z: States) -> Float[Array, "events"]:
        """Return the values of all events, including c."""
        return event_values(self.scene, motion_at(self.scene, t, *self.split(z), inputs_at(self.inputs, t)))

    def constraints(self, t, z: States) -> tuple[Array, Array]:
        """Return the constraint residuals (g, phi) and their derivatives with respect to z."""
        at = places_of(self.scene)
        v, D, _ = self.instant(self.scene, t, *self.split(z), inputs_at(self.inputs, t))
        rows = np.concatenate([at.g, at.phi])
        return v[rows], D[rows][:, np.concatenate([at.q, at.u])]

    def aligned(self, there: States, here: States) -> States:
        """Return the state `there`, with each quaternion's sign chosen so that it is nearest to `here`."""
        for first, _ in self.scene.coordinates.quaternions:
            part = slice(first, first + 4)
            there = there.at[part].multiply(jnp.where(there[part] @ here[part] < 0, -1.0, 1.0))
        return there

    def pieces_of(self, x: Unknowns) -> tuple[Float[Array, "pieces states"], Scalar]:
        """Return the states at the starts of pieces, and the period."""
        return jnp.reshape(x[:-1], (self.pieces, -1)), x[-1]

    def rows(self, x: Unknowns, ends: Float[Array, "pieces states"]) -> PerRow:
        """Return the residual R for pieces that end at `ends`, each entry divided by the size of its
        quantity.
        """
        zs, _ = self.pieces_of(x)
        there = jnp.roll(zs, -1, axis=0)
        changes = (jax.vmap(self.aligned)(ends.at[-1].add(-self.shift), there) - there) / self.sizes
        found = [
            self.constraints(self.t, zs[0])[0],
            jnp.ravel(changes[:-1]),
            changes[-1][np.array(self.kept)],
        ]
        if self.until is not None:
            found.append(self.events(self.t, zs[0])[self.until][None])
        return jnp.concatenate(found)

    def ends(self, x: Unknowns) -> Float[Array, "pieces states"]:
        """Return the states f_k at the ends of all pieces."""
        zs, period = self.pieces_of(x)
        return jax.vmap(self.moved, (0, 0, None))(jnp.arange(self.pieces), zs, period)

    def look(self, x: Unknowns) -> tuple[Array, Array, tuple[Array, Array]]:
        """Return the residual R, its Jacobian dR/dx, and df_k/dz_k with f_k."""
        zs, period = self.pieces_of(x)
        twice = lambda *of: (self.moved(*of),) * 2
        of_piece = jax.vmap(jax.jacfwd(twice, (1, 2), has_aux=True), (0, 0, None))
        (D, of_period), ends = of_piece(jnp.arange(self.pieces), zs, period)

        def linear(change):
            dz, dT = self.pieces_of(change)
            return self.rows(x + change, ends + jnp.einsum("kij,kj->ki", D, dz) + of_period * dT)

        return self.rows(x, ends), jax.jacfwd(linear)(jnp.zeros_like(x)), (D, ends)

    def multipliers(
        self, x: Unknowns, D: Float[Array, "pieces states states"], ends
    ) -> Complex[Array, "multipliers"]:
        """Return the eigenvalues of the product M_n .. M_1, largest first, from df_k/dz_k and f_k. If the
        period is unknown, the eigenvalue 1 of the perturbation along the orbit is omitted.
        """
        (zs, period), n = self.pieces_of(x), self.pieces
        kept, known = np.array(self.kept), structure_of(self.scene)
        places = kept[kept < len(self.scene.coordinate_names.entries)]
        rank = np.linalg.matrix_rank(known.closure_slopes[0][:, places]) if known.closure_slopes.size else 0
        count = len(places) - int(rank) + known.degrees_of_freedom
        there = jnp.roll(zs, -1, axis=0)
        signs = jax.vmap(jax.jacfwd(self.aligned))(ends, there)
        D = (signs @ D)[:, kept][:, :, kept]
        C = jax.vmap(lambda k, z: self.constraints(self.t + k * period / n, z)[1])(jnp.arange(n), zs)[
            :, :, kept
        ]
        B = jax.vmap(null_space_svd)(C)[:, :, len(kept) - count :]
        L = jax.lax.stop_gradient(jnp.swapaxes(B, 1, 2))
        L, following = jnp.roll(L, -1, axis=0), jnp.roll(B, -1, axis=0)
        M = jnp.linalg.solve(L @ following, L @ D @ B)
        cyclic = jnp.zeros((n, count, n, count), M.dtype).at[(np.arange(n) + 1) % n, :, np.arange(n)].set(M)
        roots = jnp.linalg.eigvals(jnp.reshape(cyclic, (n * count, -1)))
        # of the n roots of a multiplier, exactly one lies in this sector, whose bounds avoid real multipliers
        beyond = jnp.mod(jnp.angle(roots) - 0.1, 2 * np.pi) >= 2 * np.pi / n
        found = (roots**n)[jnp.argsort(beyond, stable=True)[:count]]
        found = jnp.where(jnp.abs(found.imag) < 1e-9 * jnp.abs(found), found.real, found)
        trivial = jnp.argmin(jnp.abs(found - 1)) if self.until is not None else -1
        order = jnp.lexsort((-found.imag, -jnp.round(jnp.abs(found), 9), jnp.arange(count) == trivial))
        return found[order[: count - (self.until is not None)]]
