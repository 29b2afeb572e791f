# mypy: disallow-untyped-defs, disallow-untyped-calls
# pyright: strict
"""Code without a mistake, annotated throughout: strict checkers find nothing, and know what comes back."""

from typing import Any, assert_type

import jourdain_jax as jj
from jourdain_jax.analysis import Linearization, SteadyMotion
from jourdain_jax.identification import Fit
from jourdain_jax.studies import Normal, StudyResult


class Sleigh(jj.Scene):
    mass: float = jj.parameter(1.3, unit="kg", positive=True)
    coordinates = jj.coordinates("x y heading")

    def bodies(self, t: Any, q: Any) -> dict[str, jj.RigidBody]:
        position, orientation = jj.vec(q.x, q.y, 0), jj.rot_z(q.heading)
        return {
            "sleigh": jj.RigidBody.rod(self.mass, 0.5, axis="x", position=position, orientation=orientation)
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
assert_type(jj.steady(scene, {"x_rate": 1.0}, held="x_rate"), SteadyMotion)
assert_type(jj.linearize(scene, start, ("heading",)), Linearization)
assert_type(jj.accelerations(scene, start.t, start.q, start.u), jj.Accelerations)
partial = jj.equations.partial_velocities(scene, start.t, start.q, start.u)
print(partial.linear.shape, jj.Visual.ball(0.1), jj.energy(scene, start.t, start.q, start.u).total)
