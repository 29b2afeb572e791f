"""A scene seen differently: the same motion in other units, from another frame, in other coordinates and
speeds, its bodies and rows in another order.

    r' = (R r + r_0 + v_0 t)/L        t' = t/T        m' = m/M          frame and units
    q'_k = q_k/d_k + a_k sin(q_{k-1})                 in reversed order coordinates
    u_k = d_k/T (u'_k + b_k cos(q_0 + k) u'_{k-1})                      speeds

`Seen` hands the engine a scene in the primed quantities and its author the unprimed ones: what the engine
works out must be the same motion. All of it is data, so that one program serves every way of looking, and the
plainest one (`plain`) differs by the order of bodies, rows and coordinates alone.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from jourdain_jax import Scene
from jourdain_jax.equations.rows import position_rows, velocity_rows
from jourdain_jax.scene.motion_state import BodyMotion, BodyPose, Motion, Pose


class View(eqx.Module):
    """How a scene is looked at."""

    rotation: object  # R
    shift: object  # r_0, m
    velocity: object  # v_0, m/s
    length: object  # L, m
    mass: object  # M, kg
    time: object  # T, s
    bend: object  # a_k, per coordinate
    mix: object  # b_k, per speed


def views(coordinates, speeds) -> tuple[tuple[str, ...], View]:
    """Names of the ways of looking, and all of them as one batch."""
    q, u = np.zeros(coordinates), np.zeros(speeds)
    plain = View(np.eye(3), np.zeros(3), np.zeros(3), np.array(1.0), np.array(1.0), np.array(1.0), q, u)
    moved = (
        np.asarray(jj.rot_x(0.7) @ jj.rot_z(-1.1) @ jj.rot_y(0.4)),
        np.array([0.7, -1.3, 0.4]),
        np.array([0.5, 0.2, -0.8]),
    )
    units = (np.array(1e-3), np.array(0.45), np.array(60.0))
    made = {
        "reordering of bodies, rows and coordinates": plain,
        "a rigid motion of the frame": eqx.tree_at(lambda v: (v.rotation, v.shift, v.velocity), plain, moved),
        "a change of coordinates": eqx.tree_at(
            lambda v: v.bend, plain, 0.4 * np.cos(1.0 + np.arange(coordinates))
        ),
        "a change of speeds": eqx.tree_at(lambda v: v.mix, plain, 0.5 * np.cos(2.0 + np.arange(speeds))),
        "a change of units": eqx.tree_at(lambda v: (v.length, v.mass, v.time), plain, units),
    }
    return tuple(made), jax.tree.map(lambda *x: np.stack(x), *made.values())


def other_names(names):
    """New names of the bodies, in the opposite order."""
    return tuple((name, f"body {chr(ord('z') - i)}") for i, name in enumerate(sorted(names)))


class Seen(jj.Scene):
    """`scene` as `view` shows it."""

    scene: Scene
    view: View
    names: tuple[tuple[str, str], ...] = eqx.field(static=True)  # old and new names of the bodies
    lengths: tuple[bool, ...] = eqx.field(static=True)  # whether each coordinate is a length
    paces: tuple[bool, ...] = eqx.field(static=True)  # whether each speed is the rate of one

    @property
    def coordinates(self):
        return jj.coordinates(" ".join(f"c{k}" for k in range(len(self.lengths))))

    @property
    def speeds(self):
        return jj.speeds(" ".join(f"s{k}" for k in range(len(self.paces))))

    @property
    def inputs(self):
        return self.scene.inputs

    # From what is seen to what is, and back. ----------------------------------------------------------------

    def _units(self, are_lengths):
        return jnp.stack([self.view.length if is_length else jnp.ones(()) for is_length in are_lengths])

    def new_coordinates(self, q):
        """q' of q."""
        return (q / self._units(self.lengths) + self.view.bend * jnp.sin(jnp.roll(q, 1)).at[0].set(0.0))[::-1]

    def old_coordinates(self, new):
        """q of q'."""
        d, found = self._units(self.lengths), []
        for k, value in enumerate(new[::-1]):
            found.append(d[k] * (value - (self.view.bend[k] * jnp.sin(found[-1]) if found else 0.0)))
        return jnp.stack(found)

    def _mixing(self, q):
        """b_k cos(q_0 + k) per speed."""
        return self.view.mix * jnp.cos(q[0] + jnp.arange(len(self.paces)))

    def old_speeds(self, q, new):
        """u of u'."""
        return (
            self._units(self.paces)
            / self.view.time
            * (new + self._mixing(q) * jnp.roll(new, 1).at[0].set(0.0))
        )

    def new_speeds(self, q, u):
        """u' of u."""
        scaled, mixing, found = u * self.view.time / self._units(self.paces), self._mixing(q), []
        for k in range(len(self.paces)):
            found.append(scaled[k] - (mixing[k] * found[-1] if found else 0.0))
        return jnp.stack(found)

    def _power(self):
        """The unit of power."""
        return self.view.mass * self.view.length**2 / self.view.time**3

    # The scene in the primed quantities. --------------------------------------------------------------------

    def bodies(self, t, q):
        t = t * self.view.time
        q, names = self.scene.coordinate_names.view(self.old_coordinates(q.array)), dict(self.names)
        return {names[name]: self._body(body, t) for name, body in self.scene.bodies(t, q).items()}

    def _body(self, body, t):
        view = self.view
        position = (view.rotation @ body.position + view.shift + view.velocity * t) / view.length
        if isinstance(body, jj.Particle):
            return jj.Particle(body.mass / view.mass, position)
        return jj.RigidBody(
            body.mass / view.mass,
            body.inertia / (view.mass * view.length**2),
            position,
            view.rotation @ body.orientation,
        )

    def coordinate_rates(self, t, q, u):
        t, old = t * self.view.time, self.old_coordinates(q.array)
        rates = jj.equations.coordinate_rates(self.scene, t, old, self.old_speeds(old, u.array))
        return jax.jvp(self.new_coordinates, (old,), (rates,))[1] * self.view.time

    def _pose(self, pose) -> Pose:
        """What the scene's author is shown of a pose."""
        t, old = pose.t * self.view.time, self.scene.coordinate_names.view(self.old_coordinates(pose.q.array))
        return Pose(t, old, {name: BodyPose(name, self._old_body(pose[new], t)) for name, new in self.names})

    def _old_body(self, seen, t):
        view = self.view
        position = view.rotation.T @ (view.length * seen.position - view.shift - view.velocity * t)
        if isinstance(seen.body, jj.Particle):
            return jj.Particle(view.mass * seen.mass, position)
        return jj.RigidBody(
            view.mass * seen.mass,
            view.mass * view.length**2 * seen.body.inertia,
            position,
            view.rotation.T @ seen.orientation,
        )

    def _motion(self, motion) -> Motion:
        """What the scene's author is shown of a motion."""
        view, pose, t = self.view, self._pose(motion.pose()), motion.t * self.view.time
        u = self.old_speeds(pose.q.array, motion.u.array)
        moving = {}
        for name, new in self.names:
            v = view.rotation.T @ (motion[new].velocity * view.length / view.time - view.velocity)
            omega = view.rotation.T @ motion[new].angular_velocity / view.time
            moving[name] = BodyMotion(name, pose[name].body, v, omega)
        rates = jj.equations.coordinate_rates(self.scene, t, pose.q.array, u)
        return Motion(
            t,
            pose.q,
            self.scene.speed_names.view(u),
            self.scene.coordinate_names.view(rates),
            motion.inputs,
            moving,
        )

    def loads(self, motion):
        names, seen, force = (
            dict(self.names),
            self._motion(motion),
            self._power() * self.view.time / self.view.length,
        )
        made = []
        for load in self.scene.loads(seen):
            made.append(
                jj.Load(
                    forces={names[name]: self.view.rotation @ F / force for name, F in load.forces.items()},
                    torques={
                        names[name]: self.view.rotation @ L / (force * self.view.length)
                        for name, L in load.torques.items()
                    },
                    generalized=self._new_forces(seen, load.generalized),
                    potential=(
                        None if load.potential is None else load.potential / (self._power() * self.view.time)
                    ),
                )
            )
        return tuple(made[::-1])

    def _new_forces(self, seen, generalized):
        """Forces on the new speeds with the same virtual power."""
        if not generalized:
            return {}
        Q = jnp.stack(
            [jnp.asarray(generalized.get(name, 0.0), float) for name in self.scene.speed_names.entries]
        )
        _, back = jax.vjp(lambda new: self.old_speeds(seen.q.array, new), jnp.zeros_like(Q))
        return dict(zip(self.speed_names.entries, back(Q)[0] / self._power(), strict=True))

    def potential(self, pose):
        V = self.scene.potential(self._pose(pose))
        return None if V is None else V / (self._power() * self.view.time)

    def geometric_constraints(self, pose):
        rows = position_rows(self.scene, self._pose(pose))
        return {f"seen {name}": rows[name] for name in reversed(rows)}

    def velocity_constraints(self, motion):
        seen = self._motion(motion)
        rows, held = velocity_rows(self.scene, seen), position_rows(self.scene, seen.pose())
        return {f"seen {name}": rows[name] for name in reversed(rows) if name not in held}
