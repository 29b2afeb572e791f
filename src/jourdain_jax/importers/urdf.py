"""Scenes from URDF files: links, joints, inertias, shapes.

Source: the format as in the ROS wiki, wiki.ros.org/urdf/XML.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jourdain_jax.calculus.files import FilePath
from jourdain_jax.calculus.reals import checked_known
from jourdain_jax.importers.mjcf_geoms import about
from jourdain_jax.importers.tree import Follower, Joint, Link, Look, Mass, Matrix, Motor, Tree, Vector
from jourdain_jax.importers.tree_scene import tree_scene
from jourdain_jax.importers.xml_file import Holds, Part, XmlFile
from jourdain_jax.scene.coordinates import Labels, as_labels, check_names, nearest
from jourdain_jax.scene.scene import Scene

_KINDS = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "floating": "free",
    "planar": "planar",
    "fixed": "",
}
_BASES = ("fixed", "planar", "free")
_SHAPES = {"box": ("box", ()), "sphere": ("ball", ("radius",))} | {
    kind: (kind, ("radius", "length")) for kind in ("cylinder", "capsule")
}
# Supported contents of elements; all others raise an error. Contents without effect on the motion are `idle`,
# or `listed` in a warning.
_TABLE = {
    "robot": Holds(
        "name",
        many="link joint material",
        idle="version",
        listed="transmission gazebo sensor ros2_control mujoco",
    ),
    "link": Holds(
        "name",
        one="inertial",
        many="visual",
        idle="type collision",
        listed="contact sensor self_collision_checking collision_checking self_filter surface",
    ),
    "inertial": Holds(one="origin mass inertia"),
    "mass": Holds("value"),
    "inertia": Holds("ixx ixy ixz iyy iyz izz"),
    "visual": Holds(one="origin geometry material", idle="name"),
    "geometry": Holds(one="box sphere cylinder capsule mesh", listed="plane cone ellipsoid"),
    "box": Holds("size"),
    "sphere": Holds("radius"),
    "cylinder": Holds("radius length"),
    "capsule": Holds("radius length"),
    "mesh": Holds("filename scale"),
    "material": Holds("name", one="color", idle="texture"),
    "color": Holds("rgba"),
    "joint": Holds(
        "name type",
        one="parent child origin axis limit dynamics mimic",
        idle="dont_collapse",
        listed="calibration safety_controller",
    ),
    "parent": Holds("link"),
    "child": Holds("link"),
    "origin": Holds("xyz rpy"),
    "axis": Holds("xyz"),
    "limit": Holds(
        "lower upper",
        idle="effort velocity acceleration deceleration jerk command_effort current gear_velocity",
    ),
    "dynamics": Holds("damping friction"),
    "mimic": Holds("joint multiplier offset"),
}


def from_urdf(
    path: FilePath,
    *,
    base: str = "fixed",
    motors: Iterable[str] = (),
    free: Iterable[str] = (),
    locked: Mapping[str, float] | None = None,
    packages: Mapping[str, str] | None = None,
    ignore: Iterable[str] = (),
) -> type[Scene]:
    """Return a class of scenes from a URDF file: its links are bodies, its joints coordinates.

        class Robot(jj.from_urdf("robot.urdf", base="planar", motors=["left_wheel", "right_wheel"])):
            def contacts(self, pose):
                wheels = {side: pose[f"{side}_wheel"] for side in ("left", "right")}
                return {side: jj.disc_contact(wheel, 0.033, axis="z") for side, wheel in wheels.items()}

    - `path`: path of the file, or its text.
    - `base`: the motion of the root link: "fixed"; "planar", with coordinates `x`, `y` (m) and `heading`;
      "free", with `x`, `y`, `z` and the quaternion `attitude`.
    - `motors`: names of revolute, continuous or prismatic joints that get an input, `<joint>_motor` in N m or
      N.
    - `free`: names of links whose position in the parent's frame becomes a parameter.
    - `locked`: revolute, continuous or prismatic joint -> the fixed coordinate (rad or m): `locked={"thumb":
      0.0}`.
    - `packages`: name -> folder, for meshes at `package://name/...` (default: folders of that name above the
      file).
    - `ignore`: names of elements and attributes to omit without a warning, "friction", or "text" (text
      between elements). With "inertia", impossible moments of inertia are read; motions refuse them until
      `replace` gives others.

    **Returns** a class. A joint becomes a coordinate with its name; a floating joint becomes `<joint>_x`,
    `_y`, `_z` and the quaternion `<joint>_attitude`, a planar joint `<joint>_x`, `_y`, `_heading`. If a joint
    has the name of a coordinate of the base, such as `x`, its coordinate is `x_`. Nonzero values of the file
    are fields: `<link>_mass` (kg), `<link>_mass_centre` (m, in the link's frame), `<link>_inertia` (kg m^2,
    about the mass centre), `<joint>_damping` and `gravity` (m/s^2), and `<link>_origin` (m) of links in
    `free`. Limits of joints do not stop a motion; they become the `domain`. `mimic` becomes a geometric
    constraint, without effect on fixed or locked joints. Shapes of `visual` are drawn; `collision` is not
    imported: add rolling in `contacts` of a subclass.

    **Raises** ValueError, which names the link or joint, for an unreadable file, an unknown type of joint, a
    parent or child that does not exist, a loop, and repeated definitions; for a mass without inertia,
    impossible moments of inertia (the largest above the sum of the others by more than 5 %), a joint that
    moves no mass, and a joint with friction; and for contents that do not belong to a URDF, such as a
    misspelt attribute, `spring` of `dynamics`, `loop_joint`, or text in place of an attribute. A warning
    lists omitted elements without effect on the motion, such as `gazebo` and `transmission`.
    """
    file = XmlFile(path, _TABLE, "URDF", ignore)
    if base not in _BASES:
        raise ValueError(f"`base` is {base!r}, expected one of {', '.join(map(repr, _BASES))}")
    tree = _Reader(file, packages or {}, locked or {}).tree(base, as_labels(motors), as_labels(free))
    file.warn()
    return tree_scene(tree, file.source, file.ignore)


class _Reader:
    """Reader of one file."""

    def __init__(self, file: XmlFile, packages: Mapping[str, str], locked: Mapping[str, float]):
        self.file, self.packages = file, packages
        self.locked = {
            name: float(checked_known(value, f"`locked` of `{name}`", (), advice="give one number"))
            for name, value in locked.items()
        }
        self.links, self.joints = file.named("link"), file.named("joint")
        self.colours = {m.get("name"): Part(file, "a material", m) for m in file.root.findall("material")}
        if not self.links:
            raise file.fault("it has no links")
        for name in self.locked:
            if name not in self.joints or _KINDS.get(self.joints[name].given.get("type", "")) not in (
                "hinge",
                "slide",
            ):
                raise ValueError(
                    f"`locked` names `{name}`, which is not a joint with one coordinate; "
                    f"{nearest(name, self.joints)}"
                )

    def tree(self, base: str, motors: Labels, free: Labels) -> Tree:
        """Return the mechanism in the file."""
        above: dict[str, tuple[str, str]] = {}  # link -> its joint and its parent
        for name, joint in self.joints.items():
            child, parent = (self._end(joint, which) for which in ("child", "parent"))
            if child in above:
                raise self.file.fault(
                    f"link `{child}` is the child of joints `{above[child][0]}` and "
                    f"`{name}`; a link has one parent"
                )
            above[child] = name, parent
        roots = [name for name in self.links if name not in above]
        if len(roots) != 1:
            found = (
                f"links {', '.join(f'`{name}`' for name in roots)} have none" if roots else "there is a loop"
            )
            raise self.file.fault(f"expected one link without a parent, the root; {found}")
        at_root = () if base == "fixed" else (Joint("", base),)
        content = self._content(self.links[roots[0]], base != "fixed")
        links = [Link(roots[0], None, np.zeros(3), np.eye(3), at_root, *content)]
        for link in links:  # the loop appends to the list
            links += [
                self._link(name, joint, parent)
                for name, (joint, parent) in above.items()
                if parent == link.name
            ]
        if len(links) < len(self.links):
            lost = next(name for name in self.links if name not in {link.name for link in links})
            raise self.file.fault(
                f"link `{lost}` is part of a loop of joints; a URDF is a tree, so close loops by "
                "`geometric_constraints` in a subclass"
            )
        joints = [joint for link in links for joint in link.joints]
        names = [joint.name for joint in joints if joint.kind in ("hinge", "slide")]
        check_names(motors, names, "`motors` names `{}`, which is not a joint with one coordinate")
        mimics = {joint.name: self.joints[joint.name].child("mimic") for joint in joints if joint.name}
        followers = tuple(
            self._follower(name, mimic, names) for name, mimic in mimics.items() if mimic.element is not None
        )
        pushed = tuple(Motor(f"{name}_motor", name) for name in motors)
        return Tree(
            self.file.root.get("name") or "Robot",
            tuple(links),
            np.array([0.0, 0.0, -9.81]),
            pushed,
            followers,
            free=free,
        )

    def _end(self, joint: Part, which: str) -> str:
        link = joint.child(which).given.get("link")
        if link is None:
            raise self.file.fault(f"{joint.what} has no `{which}`; name a link")
        self.file.check_name(link, self.links, f"{joint.what} has the {which} `{link}`, which is not a link")
        return link

    def _link(self, name: str, label: str, parent: str) -> Link:
        joint = self.joints[label]
        kind = joint.given.get("type", "")
        self.file.check_name(kind, _KINDS, f"{joint.what} is of the type `{kind}`")
        joints, (position, turn) = (self._joint(joint, label, kind),) if _KINDS[kind] else (), _origin(joint)
        if label in self.locked:
            axis, value, joints = joints[0].axis, self.locked[label], ()
            position, turn = (
                (position + turn @ axis * value, turn)
                if kind == "prismatic"
                else (position, turn @ about(axis, value))
            )
        return Link(name, parent, position, turn, joints, *self._content(self.links[name], bool(joints)))

    def _joint(self, joint: Part, name: str, kind: str) -> Joint:
        dynamics, limit = joint.child("dynamics"), joint.child("limit")
        damping = dynamics.number("damping", 0.0)
        if dynamics.number("friction", 0.0):
            self.file.refuse(
                "friction", f"the friction of {joint.what}", "state a smooth torque in `loads` of a subclass"
            )
        if damping < 0:
            raise dynamics.fault("damping", f"{damping:g}, expected a number >= 0")
        low, high = (limit.number(which, 0.0) for which in ("lower", "upper"))
        limits = (low, high) if low < high and kind in ("revolute", "prismatic") else None
        return Joint(
            name,
            _KINDS[kind],
            joint.child("axis").direction("xyz", [1.0, 0.0, 0.0]),
            damping=damping,
            limits=limits,
        )

    def _follower(self, name: str, mimic: Part, names: list[str]) -> Follower:
        leader = mimic.given.get("joint") or ""
        for end in (name, leader):
            self.file.check_name(end, names, f"{mimic.what}: `{end}` is not a joint with one coordinate")
        if leader == name:
            raise self.file.fault(f"joint `{name}` mimics itself; expected another joint")
        return Follower(name, leader, (mimic.number("offset", 0.0), mimic.number("multiplier", 1.0)))

    def _content(self, link: Part, moved: bool) -> tuple[Mass | None, tuple[Look, ...]]:
        """Return mass and shapes of a link."""
        looks = [
            self._look(Part(self.file, f"visual of {link.what}", visual))
            for visual in link.children("visual")
        ]
        return self._mass(link, moved), tuple(look for look in looks if look is not None)

    def _mass(self, link: Part, moved: bool) -> Mass | None:
        if not link.children("inertial"):
            return None
        inertial = link.child("inertial")
        for kind in ("mass", "inertia"):
            if not inertial.children(kind):
                raise self.file.fault(f"{link.what} has an `inertial` without `{kind}`; give both")
        centre, turn = _origin(inertial)
        xx, xy, xz, yy, yz, zz = (
            inertial.child("inertia").number(f"i{axes}") for axes in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        return link.mass(inertial.child("mass").number("value"), centre, inertia, moved=moved)

    def _look(self, visual: Part) -> Look | None:
        geometry, material = visual.child("geometry"), visual.child("material")
        shapes = [] if geometry.element is None else list(geometry.element)
        if len(shapes) != 1:
            raise self.file.fault(
                f"{visual.what} has {'several shapes' if shapes else 'no shape'} in its "
                "`geometry`, expected one"
            )
        if not material.children("color"):
            material = self.colours.get(material.given.get("name"), material)
        colour, opacity = material.child("color").colour()
        kind, shape = shapes[0].tag, Part(self.file, geometry.what, shapes[0])
        if opacity == 0:
            return None
        path = None
        if kind in _SHAPES:
            look, words = _SHAPES[kind]
            size = (
                tuple(shape.numbers("size", 3))
                if look == "box"
                else tuple(shape.number(word) for word in words)
            )
        elif (path := self._mesh_path(shape.given.get("filename"))) is not None:
            look, size = "mesh", tuple(shape.numbers("scale", 3, [1.0] * 3))
        else:
            if kind == "mesh":
                self.file.leave_out(f"mesh {shape.given.get('filename')}")
            return None
        return Look(look, size, *_origin(visual), colour, opacity, path)

    def _mesh_path(self, name: str | None) -> str | None:
        """Return the path of a mesh file, or None if it does not exist."""
        if not name:
            return None
        here = self.file.folder
        folders, rest = [here], name.removeprefix("file://")
        if name.startswith("package://"):
            package, _, rest = name.removeprefix("package://").partition("/")
            folders = (
                [Path(self.packages[package])]
                if package in self.packages
                else [above / package for above in (here, *here.parents)]
            )
            folders += [above for above in here.parents if above.name == package]
        return next((str(folder / rest) for folder in folders if os.path.isfile(folder / rest)), None)


def _origin(part: Part) -> tuple[Vector, Matrix]:
    origin = part.child("origin")
    # rotations about the fixed axes x, y, z, in this order
    turn = Rotation.from_euler("xyz", origin.numbers("rpy", 3, np.zeros(3)))
    return origin.numbers("xyz", 3, np.zeros(3)), turn.as_matrix()
