"""Random admissible states of a scene, and all its reductions against each other there."""

import numpy as np
from solved_states import over_states

import jourdain_jax as jj
from jourdain_jax.equations import unconstrained_equations


def admissible_states(scene, count, seed=0):
    """Random states (t, q, u) on the constraints."""
    return list(zip(*jj.sample_states(scene, count, seed), strict=True))


def disagreement(scene, count=20, seed=0):
    """Largest difference of accelerations and constraint forces from those by QR, relative to the largest at
    each state.

    The size of forces is the largest of constraint, impressed and inertia forces, for scenes without
    constraints. Reductions that say that they do not apply at some state are left out.
    """
    by_name = jj.reductions(scene)

    def all_of_them(t, q, u):
        found = {
            name: jj.accelerations(scene, t, q, u, reduction=reduction) for name, reduction in by_name.items()
        }
        equations = unconstrained_equations(scene, t, q, u)
        forces = np.stack([equations.h, equations.Q, found["qr"].constraint_force])
        sizes = np.max(np.abs(found["qr"].udot)), np.max(np.abs(forces))
        return {name: (a.udot, a.constraint_force, a.applicable) for name, a in found.items()}, sizes

    states = admissible_states(scene, count, seed)
    assert len(states) >= count // 2
    results, sizes = over_states(all_of_them, *zip(*states, strict=True))
    return {
        name: max(_relative(*compared) for compared in zip(result[:2], results["qr"][:2], sizes, strict=True))
        for name, result in results.items()
        if name != "qr" and np.all(result[2])
    }


def _relative(values, expected, size):
    return float(np.max(np.max(np.abs(values - expected), axis=1) / np.where(size > 0, size, 1.0)))
