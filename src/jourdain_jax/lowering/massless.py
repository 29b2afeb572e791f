"""Singular inertias of a scene, for its parameters or for the values that traced ones may take."""

from dataclasses import fields

import jax
import numpy as np

from jourdain_jax.build.structure import Structure, structure_of
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.scene import Scene


def may_be_massless(scene: Scene, structure: Structure) -> bool:
    """Return whether M is singular at the parameters of `scene`, or with zero for those traced ones that need
    not be positive.

    These are parameters declared `non_negative` and those whose default is zero; where privileged speeds serve, so that it costs nothing, all that are not
    declared `positive`.
    """
    if structure.massless:
        return True
    without = _with_zeros(scene, every=structure.well_conditioned)
    if without is None:
        return False
    try:
        return structure_of(without).massless
    except ValueError:  # all of them at once cannot be zero; some may
        return True


def _with_zeros(scene: Scene, every: bool) -> Scene | None:
    """Return numbers for the scene's parameters, with all permitted zeros; None if there are none."""
    may_vanish = {f.name for f in fields(scene) if (every and not f.metadata.get("positive")) or f.metadata.get("non_negative") or np.array_equal(f.default, 0)}
    given, treedef = jax.tree_util.tree_flatten_with_path(scene)
    zeros = [is_traced(x) and jax.tree_util.keystr(path[:1]).strip(".") in may_vanish for path, x in given]
    leaves = [np.zeros_like(y) if zero else y for zero, y in zip(zeros, jax.tree.leaves(with_reference_parameters(scene)), strict=True)]
    return jax.tree.unflatten(treedef, leaves) if any(zeros) else None
