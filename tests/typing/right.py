# mypy: disallow-untyped-defs, disallow-untyped-calls
"""Code without a mistake, annotated throughout: strict checkers find nothing, and know what comes back."""

from typing import Any, assert_type

import jax.numpy as jnp

import jourdain_jax as jj
from jourdain_jax.identification import Fit
from jourdain_jax.studies import Normal, StudyResult


class Sleigh(jj.Scene):
    mass: float = jj.parameter(1.3, unit="kg", positive=True)
    coordinates = jj.coordinates("x y heading")

    def bodies(self, t: Any, q: Any) -> dict[str, jj.RigidBody]:
        return {
            "sleigh": jj.RigidBody(
                self.mass, jnp.ones(3), jnp.stack([q.x, q.y, 0.0 * q.x]), jj.rot_z(q.heading)
            )
        }


scene = Sleigh(mass=1.0).replace(mass=2.0)
assert_type(scene, Sleigh)
start = jj.start(scene, x_rate=1.0, heading_rate=0.5)
assert_type(jj.simulate(scene, start, t1=1.0), jj.Trajectory)
assert_type(jj.rollout(jj.models.TiltingDisc(mass=2.0), {"lean": 0.3}, t1=1.0, rtol=1e-6), jj.Rollout)
assert_type(
    jj.fit(scene, jj.Experiment([0.0, 1.0], {"x": [0.0, 1.0]}, 0.01, start={"x_rate": 1.0}), free=["mass"]),
    Fit,
)
assert_type(
    jj.Study(scene, vary={"mass": Normal(1.0, 0.1)}, samples=8).run("study.zarr", t1=1.0), StudyResult
)
