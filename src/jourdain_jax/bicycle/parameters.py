"""The parameters of the Whipple bicycle, and their possible values.

Names as in Meijaard, Papadopoulos, Ruina & Schwab (Proc. R. Soc. A 463, 2007, table 1): origin at the rear
contact, x forward, z down; R rear wheel, B rear frame with rider, H handlebar and fork, F front wheel. Wheels
have Izz = Ixx.
"""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool

from jourdain_jax.models.whipple_bicycle import WhippleBicycle
from jourdain_jax.scene.coordinates import Labels, Sentences

# name -> unit, meaning and sign, in the order of the paper's table and of arrays of parameters
PARAMETERS: "dict[str, Mapping[str, Any]]" = {
    field.name: field.metadata for field in fields(WhippleBicycle) if field.metadata.get("parameter")
}
PARAMETER_NAMES: Labels = tuple(PARAMETERS)


def violations(values: Mapping[str, float | Array]) -> dict[str, Bool[Array, "*samples"]]:
    """Return the conditions on possible bicycles, and whether the values violate them. NaN counts as a
    violation.

    **Arguments:** `values`: number, or array of samples of one common shape, for every name of
    `PARAMETER_NAMES`. **Returns:** condition, as a sentence -> True for values that violate it.
    """
    broken = {}
    for name, known in PARAMETERS.items():
        if known["positive"] or name == "g":
            broken[f"`{name}` ({known['about']}) must be positive"] = ~(jnp.asarray(values[name]) > 0)
        elif known["non_negative"]:
            broken[f"`{name}` ({known['about']}) must not be negative"] = ~(jnp.asarray(values[name]) >= 0)
    upright = jnp.abs(jnp.asarray(values["lam"])) < math.pi / 2
    broken["`lam` (steer axis tilt, in radians) must lie between -pi/2 and pi/2"] = ~upright
    return broken


def doubts(values: Mapping[str, float]) -> Sentences:
    """Return one sentence for each doubtful value of a bicycle. Doubtful values do not prevent a simulation.

    The inertia matrix of a body should be positive definite, and each principal moment of inertia at most the
    sum of the other two.

    **Arguments:** `values`: number for every name of `PARAMETER_NAMES`.
    """
    found = []
    for wheel in "RF":
        if values[f"I{wheel}yy"] > 2 * values[f"I{wheel}xx"]:
            found.append(
                f"`I{wheel}yy` > 2 `I{wheel}xx`: no wheel, even a flat one, has such moments of inertia"
            )
    for body in "BH":
        xx, yy, zz, xz = (values[f"I{body}{axes}"] for axes in ("xx", "yy", "zz", "xz"))
        middle, half_spread = (xx + zz) / 2, math.hypot((xx - zz) / 2, xz)
        # principal moments in the plane of symmetry
        smallest, largest = middle - half_spread, middle + half_spread
        if smallest <= 0 or yy <= 0:
            found.append(f"the inertia matrix of body {body} is not positive definite")
        if yy > smallest + largest or largest > smallest + yy:
            found.append(f"a principal moment of inertia of body {body} exceeds the sum of the other two")
        if values[f"z{body}"] > 0:
            found.append(
                f"`z{body}` > 0: the centre of mass of body {body} lies below the ground (z points down)"
            )
    return tuple(found)
