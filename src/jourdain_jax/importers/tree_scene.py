"""Scenes of links and joints: poses along the tree, gravity, springs, dampers, motors, and shapes."""

from functools import lru_cache
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Matrix3, Vector3, real_type
from jourdain_jax.calculus.rotations import onto_axis, quaternion_to_matrix
from jourdain_jax.importers.mjcf_geoms import combined
from jourdain_jax.importers.scene_class import identifiers, scene_class
from jourdain_jax.importers.tree import Follower, Joint, Link, Look, Mass, Push, Tree
from jourdain_jax.scene.bodies import RigidBody, Visual
from jourdain_jax.scene.coordinates import (
    Labels,
    Quaternion,
    check_names,
    coordinates,
    inputs,
    parameter,
    quaternion,
)
from jourdain_jax.scene.loads import Load, generalized_force, gravity, point_force, torque
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.plausibility import ROUNDED

POINT = 1e-6**2  # physics, m^2: moments of a smaller squared radius of gyration are round-off

Frame = tuple[Matrix3, Vector3]  # orientation and origin in the inertial frame


class TreeScene(Scene):
    """Base of the scenes made by `from_urdf` and `from_mjcf`."""

    _tree: ClassVar[Tree]
    _names: ClassVar[dict[str, str]]  # of links and joints -> identifiers

    def bodies(self, t, q):
        """Return the links that move and have a mass."""
        moving = self._tree.moving()
        frames = self._frames(q)
        found = {}
        for link in self._tree.links:
            if link.name in moving and link.mass is not None:
                R, origin = frames[link.name]
                name = self._names[link.name]
                mass, inertia = getattr(self, f"{name}_mass"), getattr(self, f"{name}_inertia")
                found[link.name] = RigidBody(
                    mass, inertia, _array(origin + R @ self._centre(link)), _array(R)
                )
        return found

    def loads(self, motion):
        """Return gravity, and the springs, dampers and motors of the joints."""
        size = float(np.linalg.norm(self._tree.gravity))
        found = [gravity(motion, self.gravity, self._tree.gravity / size)] if size else []
        for link in self._tree.links:
            for joint in link.joints:
                found += self._of_joint(motion, joint)
        for motor in self._tree.motors:
            push = motion.inputs[self._names[motor.name]]
            for limits in (motor.control, motor.force):
                push = push if limits is None else jnp.clip(push, *limits)
            if motor.push is None:
                found.append(
                    generalized_force(motion, **{f"{self._names[motor.joint]}_rate": motor.gear * push})
                )
            else:
                found += self._of_push(motion, motor.push, push)
        return tuple(found)

    def geometric_constraints(self, pose):
        """Return the constraints of dependent joints (`Follower`) and of closed loops."""
        if not self._tree.ties:
            return {}
        q, found = self.coordinates.reference(), {}
        q[[self.coordinate_names.entries.index(name) for name in self._tree.start]] = list(
            self._tree.start.values()
        )
        now, stated = self._frames(pose.q), self._frames(self.coordinate_names.view(_array(q)))
        moved = {
            j.name: pose.q[self._names[j.name]] - j.reference
            for link in self._tree.links
            for j in link.joints
            if j.kind in ("hinge", "slide")
        }
        for one in self._tree.ties:
            if isinstance(one, Follower):
                expected = sum(
                    c * moved.get(one.leader, 0.0) ** k for k, c in enumerate(one.coefficients) if c
                )
                found[f"{one.joint} follows {one.leader}" if one.leader else f"{one.joint} is held"] = (
                    moved[one.joint] - expected
                )
                continue
            R, r = now[one.link]
            other_R, other_r = now[one.other]
            S, s = stated[one.link]
            other_S, other_s = stated[one.other]
            found[one.name] = (
                r + R @ one.anchor - other_r - other_R @ (other_S.T @ (s + S @ one.anchor - other_s))
            )
            if one.turn:  # the vector part of the rotation since the stated pose
                turned = R.T @ other_R @ other_S.T @ S
                found[f"{one.name}, attitude"] = jnp.stack(
                    [turned[k - 1, k - 2] - turned[k - 2, k - 1] for k in range(3)]
                )
        return found

    def visuals(self, pose):
        """Return the shapes in the file. Shapes of links without a body are fixed in the inertial frame."""
        frames = self._frames(pose.q)
        found: dict[str, list[Visual]] = {}
        for link in self._tree.links:
            for look in link.looks:
                if link.name in pose:
                    found.setdefault(link.name, []).append(
                        _visual(look, look.position - self._centre(link), look.turn)
                    )
                else:
                    R, origin = frames[link.name]
                    found.setdefault("", []).append(_visual(look, origin + R @ look.position, R @ look.turn))
        return found

    def _frames(self, q) -> dict[str | None, Frame]:
        """Return orientation and origin of every link."""
        found: dict[str | None, Frame] = {None: (np.eye(3), np.zeros(3))}
        for link in self._tree.links:
            R, origin = found[link.parent]
            field = f"{self._names[link.name]}_origin"
            R, origin = R @ link.turn, origin + R @ getattr(self, field, link.position)
            for joint in link.joints:
                R, origin = _moved(joint, self._names[joint.name], R, origin, q)
            found[link.name] = R, origin
        return found

    def _centre(self, link: Link):
        """Return the mass centre in the frame of the link, m."""
        return getattr(self, f"{self._names[link.name]}_mass_centre", np.zeros(3))

    def _of_push(self, motion, push: Push, size):
        """Yield the force and the torque of a motor."""
        body, link = motion[push.link], next(link for link in self._tree.links if link.name == push.link)
        yield point_force(body.point(push.point - self._centre(link)), size * (body.orientation @ push.force))
        if np.any(push.torque):
            yield torque(motion, push.link, size * (body.orientation @ push.torque))

    def _of_joint(self, motion, joint: Joint):
        name = self._names[joint.name]
        if joint.stiffness:
            k, stretch = getattr(self, f"{name}_stiffness"), motion.q[name] - joint.rest
            yield Load(generalized={f"{name}_rate": -k * stretch}, potential=0.5 * k * stretch**2)
        if joint.damping:
            c = getattr(self, f"{name}_damping")
            yield generalized_force(
                motion,
                **{
                    speed: -c * motion.u[speed]
                    for speed in coordinates(*parts_of(joint, name)).default_speeds
                },
            )


def _array(x) -> Float[Array, "*shape"]:
    return jnp.asarray(x, real_type())


def parts_of(joint: Joint, name: str) -> tuple[str | Quaternion, ...]:
    """Return the coordinates of a joint, as arguments of `jj.coordinates`. Coordinates of the
    base have no prefix.
    """
    label = f"{name}_" if joint.name else ""
    if joint.kind == "ball":
        return (quaternion(name),)
    if joint.kind == "free":
        return (f"{label}x {label}y {label}z", quaternion(f"{label}attitude"))
    if joint.kind == "planar":
        return (f"{label}x {label}y {label}heading",)
    return (name,)


def _moved(joint: Joint, name: str, R, origin, q) -> Frame:
    """Return the frame after a joint has moved it."""
    label = f"{name}_" if joint.name else ""
    if joint.kind == "slide":
        return R, origin + R @ joint.axis * (q[name] - joint.reference)
    if joint.kind == "free":
        shift = jnp.stack([q[f"{label}{axis}"] for axis in "xyz"])
        return R @ quaternion_to_matrix(q[f"{label}attitude"]), origin + R @ shift
    if joint.kind == "planar":
        across = _in_plane(joint.axis)
        return R @ _about(joint.axis, q[f"{label}heading"]), origin + R @ (
            across[0] * q[f"{label}x"] + across[1] * q[f"{label}y"]
        )
    turn = (
        quaternion_to_matrix(q[name])
        if joint.kind == "ball"
        else _about(joint.axis, q[name] - joint.reference)
    )
    held = origin + R @ joint.anchor
    R = R @ turn
    return R, held - R @ joint.anchor


def _about(axis, angle) -> Matrix3:
    """Return the rotation by an angle, which may be traced, about a known axis."""
    along = np.outer(axis, axis)
    return along + jnp.cos(angle) * (np.eye(3) - along) + jnp.sin(angle) * np.cross(np.eye(3), axis)


def _in_plane(normal) -> Float[np.ndarray, "2 3"]:
    """Return two unit vectors in a plane: x and y for the normal z, y and z for x, z and x for y."""
    k = int(np.argmax(np.abs(normal)))
    if np.isclose(normal[k], 1.0):
        return np.eye(3)[[(k + 1) % 3, (k + 2) % 3]]
    return onto_axis(normal)[:, :2].T


def _visual(look: Look, at, turn) -> Visual:
    options: dict[str, Any] = {
        "at": _array(at),
        "turn": _array(turn),
        "colour": look.colour,
        "opacity": look.opacity,
    }
    if look.kind == "mesh":
        mesh = _mesh(look.path)
        return Visual.mesh(mesh.faces.corners, mesh.faces.polygons, scale=np.array(look.size), **options)
    size = (np.array(look.size),) if look.kind in ("box", "ellipsoid") else look.size
    return getattr(Visual, look.kind)(*size, **options)


@lru_cache(maxsize=256)
def _mesh(path: str) -> Any:
    return Visual.from_file(path)


def tree_scene(tree: Tree, source: str, ignore: Labels) -> type[Scene]:
    """Return the class of scenes of a mechanism. Raises ValueError, with the `source`, if nothing moves, a
    moving part has no mass, or moments of inertia are impossible.

    `ignore`: if it contains "inertia", impossible moments are accepted here, but not by motions.
    """
    moving = tree.moving()
    if not moving:
        raise ValueError(
            f"{source}: no joint moves a body; expected at least one moving joint, or a moving base, such as "
            'base="free"'
        )
    _check_masses(tree, source, ignore)
    check_names(tree.free, [link.name for link in tree.links], "`free` names `{}`, which is not a link")
    joints = [joint for link in tree.links for joint in link.joints]
    link_names = identifiers([link.name for link in tree.links], "link")
    of_base = () if all(joint.name for joint in joints) else ("x", "y", "z", "heading", "attitude")
    joint_names = identifiers([joint.name for joint in joints if joint.name], "joint", taken=of_base)
    names = {"": ""} | link_names | joint_names | identifiers([motor.name for motor in tree.motors], "motor")
    parameters: dict[str, Any] = {}
    for link in tree.links:
        name = link_names[link.name]
        if link.name in tree.free:
            about = f"of the frame of {link.name}, in the frame of {link.parent or 'the ground'}"
            parameters[f"{name}_origin"] = parameter(link.position, unit="m", about=about)
        if link.name in moving and link.mass is not None:
            parameters |= _mass_parameters(link, name)
    for joint in joints:
        turns = joint.kind == "hinge"
        for what, unit in (
            ("damping", "N m s" if turns else "N s/m"),
            ("stiffness", "N m" if turns else "N/m"),
        ):
            if getattr(joint, what):
                parameters[f"{names[joint.name]}_{what}"] = parameter(
                    getattr(joint, what), unit=unit, about=f"of {joint.name}"
                )
    if np.any(tree.gravity):
        parameters["gravity"] = parameter(float(np.linalg.norm(tree.gravity)), unit="m/s^2")
    limits = {
        names[joint.name]: joint.limits
        for joint in joints
        if joint.limits is not None and joint.kind in ("hinge", "slide")
    }
    attributes = {
        "coordinates": coordinates(
            *(part for joint in joints for part in parts_of(joint, names[joint.name]))
        ),
        "inputs": inputs(" ".join(names[motor.name] for motor in tree.motors)),
        "domain": limits,
        "example": dict(tree.start),
        "_tree": tree,
        "_names": names,
    }
    about = (
        f"{tree.name}, from {source}:"
        f" {', '.join(link.name for link in tree.links if link.name in moving and link.mass is not None)}."
    )
    return scene_class(TreeScene, tree.name, about, parameters, attributes)


def _mass_parameters(link: Link, name: str) -> dict[str, Any]:
    assert link.mass is not None
    inertia = np.where(np.abs(link.mass.inertia) > POINT * link.mass.mass, link.mass.inertia, 0.0)
    is_diagonal = not np.any(inertia - np.diag(np.diag(inertia)))
    found = {
        f"{name}_mass": parameter(link.mass.mass, unit="kg", positive=link.mass.mass > 0),
        f"{name}_inertia": parameter(
            np.diag(inertia) if is_diagonal else inertia,
            unit="kg m^2",
            about="about its mass centre, along its axes",
        ),
    }
    if np.any(link.mass.centre):
        found[f"{name}_mass_centre"] = parameter(
            link.mass.centre, unit="m", about=f"in the frame of {link.name}"
        )
    return found


def _check_masses(tree: Tree, source: str, ignore: Labels) -> None:
    """Raise ValueError for a joint that moves no mass, and for impossible moments of inertia. Links that are
    fixed to each other are combined.
    """
    heavy: set[str] = set()
    fixed: dict[str | None, list[Mass]] = {
        link.name: [] if link.mass is None else [link.mass] for link in tree.links
    } | {None: []}
    for link in reversed(tree.links):
        if link.joints or link.parent is None:
            if fixed[link.name] and "inertia" not in ignore:
                _check_moments(
                    combined(fixed[link.name]),
                    f"{source}: link "
                    f"`{link.name}`{', with links fixed to it,' if len(fixed[link.name]) > 1 else ''}",
                )
        else:
            fixed[link.parent] += [
                Mass(m.mass, link.position + link.turn @ m.centre, link.turn @ m.inertia @ link.turn.T)
                for m in fixed[link.name]
            ]
        if (link.mass is not None or link.name in heavy) and link.parent is not None:
            heavy.add(link.parent)
        if link.joints and link.mass is None and link.name not in heavy:
            joint = link.joints[0].name or "the base"
            raise ValueError(
                f"{source}: link `{link.name}`, moved by `{joint}`, has no mass, and neither has any link "
                "that it carries; give it an `inertial`"
            )


def _check_moments(mass: Mass, what: str) -> None:
    """Raise ValueError unless 0 <= I_1 <= I_2 <= I_3 <= I_1 + I_2."""
    least, middle, largest = np.linalg.eigvalsh(mass.inertia)
    if max(-least, largest - least - middle) > max(ROUNDED * largest, POINT * mass.mass):
        raise ValueError(
            f"{what} has principal moments of inertia {least:.4g}, {middle:.4g} and {largest:.4g} kg m^2, "
            "impossible for a body; expected none below zero, and the "
            f"largest at most the sum of the others (within {ROUNDED:.0%}): check signs, "
            "units and products of inertia, or give "
            'ignore=("inertia",) and replace them'
        )
