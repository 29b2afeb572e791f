"""Probes of a scene and their findings: quantities that vanish or change, and speeds without inertia."""

from dataclasses import replace

import numpy as np

from jourdain_jax.calculus.reals import all_finite, at_index, eps_of, largest
from jourdain_jax.program.graph import Unsupported
from jourdain_jax.scene.names import Sentences
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.plausibility import without_inertia
from jourdain_jax.structure.probes import Probed, probed_on_graph
from jourdain_jax.structure.rank import Scaled, scaled_states
from jourdain_jax.structure.sampling import symmetric_configurations

RANDOM_PROBES = 24


def moves(rates: np.ndarray) -> bool:
    """Return whether any rate is a number other than zero."""
    return bool(np.any(np.isfinite(rates) & (rates != 0)))


def exceeds(difference: np.ndarray, tolerance: float, size: np.ndarray) -> bool:
    """Return whether any entry exceeds `tolerance` times the size of its row. Sizes are relative because
    constraints may have any unit.
    """
    size = np.maximum(size, np.nanmedian(size, axis=0, keepdims=True)) if size.size else size
    return bool(np.any(np.abs(difference) > tolerance * size))


def sizes(found: Probed) -> np.ndarray:
    """Return the largest entry of every row, at every state."""
    return largest(found.A, 2)


def _look(scene: Scene, t, q, u, u_other, generic) -> Probed:
    try:
        found = probed_on_graph(scene, t, q, u, u_other, generic)
        if not found.in_calls:
            return found
        # results of JAX calls may be nonzero only far from the probes, so a few distant states are probed too
        generator, count = np.random.default_rng(1), 16
        far = 100.0 * generator.uniform(size=count), q[:count] * 100.0 ** generator.uniform(size=(count, 1))
        for first, _ in scene.coordinates.quaternions:
            far[1][:, first : first + 4] = q[:count, first : first + 4]
        u, u_other = 100.0 * generator.uniform(-1, 1, (2, count, u.shape[1]))
        beyond = probed_on_graph(scene, *far, u, u_other, np.ones(count, bool), tries=0)
        unproved = (found.unproved - found.in_calls) | (found.in_calls & _seen(beyond, u))
        return replace(found, unproved=unproved)
    except Unsupported as reason:
        raise ValueError(
            f"the motion of `{type(scene).__name__}` needs {reason}, for which JAX has no forward mode; give "
            "that part a rule with `jax.custom_jvp`"
        ) from None


def _seen(found: Probed, u: np.ndarray) -> frozenset[str]:
    """Return the quantities that are nonzero at distant states; for constraints, beyond round-off."""
    some = np.sqrt(eps_of(found.A))
    seen = {name for name, rates in found.vanishing.items() if moves(rates)} - {"rows at rest"}
    rows = (
        {"rows at rest"} if exceeds(found.vanishing["rows at rest"], some, speed_terms(found, u)) else set()
    )
    rows |= {"nonlinear"} if exceeds(found.A - found.A_other, some, sizes(found)[..., None]) else set()
    return frozenset(seen | rows)


def speed_terms(found: Probed, u: np.ndarray) -> np.ndarray:
    """Return the sizes of the terms of every constraint at the probed speeds."""
    return np.einsum("srk,sk->sr", np.abs(found.A), np.abs(u))


def at_probes(scene: Scene, t, q, u) -> tuple[np.ndarray, np.ndarray, np.ndarray, Probed]:
    """Probe a scene at random and symmetric states. Return times, speeds, flags of random states, and the
    probed quantities.
    """
    symmetric = symmetric_configurations(scene)
    t, q = np.concatenate([t, np.zeros(len(symmetric))]), np.concatenate([q, symmetric])
    u = np.concatenate([u, u[:1].repeat(len(symmetric), 0)])
    generic = np.arange(len(t)) < RANDOM_PROBES
    return t, u, generic, _look(scene, t, q, u, -u[::-1], generic)


def is_singular(M: np.ndarray) -> bool:
    """Return whether scaled mass matrices are singular at all states."""
    if not M.size:
        return False
    least = np.linalg.eigvalsh(np.nan_to_num(M, nan=1.0))[:, 0]
    return bool(np.all(least <= 16 * M.shape[1] * eps_of(M)))


def no_inertia(scene: Scene, found: Scaled) -> Sentences:
    """Return an error message with the names of the speeds if a free motion lacks inertia at every state."""
    if not (len(found.M) and without_inertia(found.M, found.A).all()):
        return ()
    directions = np.linalg.eigh(np.nan_to_num(found.M + found.A.mT @ found.A, nan=1.0))[1][..., 0]
    moved = np.abs(found.c * directions)
    share = np.median([x / x.max() for x in moved], axis=0)
    moving = [f"`{name}`" for name, part in zip(scene.speed_names.entries, share, strict=True) if part > 1e-3]
    names = ", ".join(moving) + (" together" if len(moving) > 1 else "")
    return (
        f"nothing in `{type(scene).__name__}` has inertia along {names}: no mass moves with it and no "
        "constraint determines it; give a body that moves with it a mass (or inertia), add a constraint, or "
        "omit the coordinate",
    )


def far_rows(scene: Scene, typical: np.ndarray, t, q, u) -> Scaled:
    """Return scaled rows at states on the geometric constraints, with coordinates up to half a turn from
    q.
    """
    generator = np.random.default_rng(4)
    t, q, u = (x[:RANDOM_PROBES].repeat(2, 0) for x in (t, q, u))
    turned = q + generator.uniform(-np.pi, np.pi, q.shape)
    for first, _ in scene.coordinates.quaternions:
        turned[:, first : first + 4] = q[:, first : first + 4]
    found = _look(scene, t, turned, u, -u, np.zeros(len(t), bool))
    good = np.isfinite(found.error) & all_finite(found.A, axis=(1, 2))
    return at_index(scaled_states(found, typical), good)
