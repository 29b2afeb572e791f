"""Scenes from URDF files: links, joints, inertias, shapes.

Source: the format as the ROS wiki describes it, wiki.ros.org/urdf/XML.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from jourdain_jax.importers.placing import by_roll_pitch_yaw
from jourdain_jax.importers.tree import Follower, Joint, Link, Look, Mass, Matrix, Motor, Tree, Vector
from jourdain_jax.importers.tree_scene import tree_scene
from jourdain_jax.importers.xml_file import Element, Holds, XmlFile
from jourdain_jax.scene.names import as_labels, nearest
from jourdain_jax.scene.scene import Scene

_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "floating": "free", "planar": "planar", "fixed": ""}
_BASES = ("fixed", "planar", "free")
# What elements may hold; all else is refused by name. Elements that are read are idle, or listed, where they move nothing.
_TABLE = {
    "robot": Holds("name", many="link joint material", idle="version", listed="transmission gazebo sensor ros2_control mujoco"),
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
    "joint": Holds("name type", one="parent child origin axis limit dynamics mimic", idle="dont_collapse", listed="calibration safety_controller"),
    "parent": Holds("link"),
    "child": Holds("link"),
    "origin": Holds("xyz rpy"),
    "axis": Holds("xyz"),
    "limit": Holds("lower upper", idle="effort velocity acceleration deceleration jerk command_effort current gear_velocity"),
    "dynamics": Holds("damping friction"),
    "mimic": Holds("joint multiplier offset"),
}


def from_urdf(
    path, *, base: str = "fixed", motors: Iterable[str] = (), free: Iterable[str] = (), packages: Mapping[str, str] | None = None, ignore: Iterable[str] = ()
) -> type[Scene]:
    """A class of scenes from a URDF file: its links are bodies, its joints coordinates.

        class Robot(jj.from_urdf("robot.urdf", base="planar", motors=["left_wheel", "right_wheel"])):
            def contacts(self, pose):
                return {side: jj.disc_contact(pose[f"{side}_wheel"], 0.033, axis="z") for side in ("left", "right")}

    - `path`: of the file, or its text.
    - `base`: how the root link moves: "fixed"; "planar", coordinates `x`, `y` (m) and `heading`; "free", `x`, `y`, `z` and the quaternion `attitude`.
    - `motors`: names of revolute, continuous or prismatic joints that an input pushes, `<joint>_motor` in N m or N.
    - `free`: names of links whose place in the frame of their parent is a parameter.
    - `packages`: name -> folder, for meshes at `package://name/...` (default: folders of that name above the file).
    - `ignore`: what may be left out without a word: names of elements and attributes, "friction", or "text" between elements. With
      "inertia", moments of inertia that no body has are taken as they are.

    **Returns** a class. A joint is a coordinate of its own name; a floating one is `<joint>_x`, `_y`, `_z` and the quaternion `<joint>_attitude`, a planar
    one `<joint>_x`, `_y`, `_heading`. Fields, as far as they are not zero in the file: `<link>_mass` (kg), `<link>_mass_centre` (m, in the link's frame),
    `<link>_inertia` (kg m^2, about the mass centre), `<joint>_damping` and `gravity` (m/s^2); and of links that `free` names `<link>_origin` (m). Limits of
    joints stop nothing; they become the `domain`. `mimic` is a geometric row. Shapes of `visual` are drawn; `collision` is not read: rolling is stated in
    `contacts` of a subclass.

    **Raises** ValueError with the name of the link or joint: a file that cannot be read, an unknown type of joint, a parent or child that does not exist, a
    loop, a mass without inertia, moments of inertia that no body has (the largest above the sum of the others by more than 5 %), a joint that moves no mass, a
    joint with friction, what is said twice; and by its name all that an element of a URDF does not hold: a misspelt attribute, `spring` of `dynamics`,
    `loop_joint`, text in place of an attribute. A warning lists elements that move nothing and are left out, such as `gazebo` and `transmission`.
    """
    file = XmlFile(path, _TABLE, "URDF", ignore)
    if base not in _BASES:
        raise ValueError(f"`base` is {base!r}, expected one of {', '.join(map(repr, _BASES))}")
    links = file.named(file.root.findall("link"), "link")
    joints = list(file.named(file.root.findall("joint"), "joint").values())
    if not links:
        raise file.fault("it has no links")
    tree = _Reader(file, links, packages or {}).tree(joints, base, as_labels(motors), as_labels(free))
    file.warn()
    return tree_scene(tree, file.source, file.ignore)


class _Reader:
    """Reads the elements of one file."""

    def __init__(self, file: XmlFile, links: dict[str, Element], packages: Mapping[str, str]):
        self.file, self.links, self.packages = file, links, packages
        self.colours = {m.get("name"): m for m in file.root.findall("material")}

    def tree(self, joints: list[Element], base: str, motors: tuple[str, ...], free: tuple[str, ...]) -> Tree:
        """The whole mechanism."""
        holder: dict[str, Element] = {}  # child -> its joint
        for joint in joints:
            name = self.file.name(joint, "joint")
            child = self._end(joint, "child", name)
            self._end(joint, "parent", name)
            if child in holder:
                raise self.file.fault(f"link `{child}` is the child of joints `{holder[child].get('name')}` and `{name}`; a link has one parent")
            holder[child] = joint
        roots = [name for name in self.links if name not in holder]
        if len(roots) != 1:
            found = f"links {', '.join(f'`{name}`' for name in roots)} have none" if roots else "there is a loop"
            raise self.file.fault(f"expected one link without a parent, the root; {found}")
        links = [self._root(roots[0], base)]
        for link in links:  # it grows
            held = [name for name, joint in holder.items() if self._end(joint, "parent", "") == link.name]
            links += [self._link(name, holder[name]) for name in held]
        if len(links) < len(self.links):
            lost = next(name for name in self.links if name not in {link.name for link in links})
            raise self.file.fault(f"link `{lost}` hangs in a loop of joints; a URDF is a tree, close loops by `geometric_constraints` in a subclass")
        names = [joint.name for link in links for joint in link.joints if joint.kind in ("hinge", "slide")]
        for name in motors:
            if name not in names:
                raise ValueError(f"`motors` names `{name}`, which is no joint of one coordinate; {nearest(name, names)}")
        followers = tuple(self._follower(joint, names) for joint in joints if joint.find("mimic") is not None and joint.get("type") != "fixed")
        pushed = tuple(Motor(f"{name}_motor", name) for name in motors)
        return Tree(self.file.root.get("name") or "Robot", tuple(links), np.array([0.0, 0.0, -9.81]), pushed, followers, free=free)

    def _end(self, joint: Element, which: str, name: str) -> str:
        found = joint.find(which)
        link = None if found is None else found.get("link")
        if link is None:
            raise self.file.fault(f"joint `{name}` has no `{which}`; name a link")
        if link not in self.links:
            raise self.file.fault(f"joint `{name}` has the {which} `{link}`, which is no link; {nearest(link, self.links)}")
        return link

    def _root(self, name: str, base: str) -> Link:
        joints = () if base == "fixed" else (Joint("", base),)
        return Link(name, None, np.zeros(3), np.eye(3), joints, *self._content(name))

    def _link(self, name: str, joint: Element) -> Link:
        label = joint.get("name") or ""
        kind = joint.get("type")
        if kind not in _KINDS:
            raise self.file.fault(f"joint `{label}` is of the type `{kind}`; {nearest(str(kind), _KINDS)}")
        position, turn = self._origin(joint, f"joint `{label}`")
        moved = (self._joint(joint, label, _KINDS[kind], kind),) if _KINDS[kind] else ()
        parent = self._end(joint, "parent", label)
        return Link(name, parent, position, turn, moved, *self._content(name))

    def _joint(self, joint: Element, name: str, kind: str, given: str) -> Joint:
        stated = joint.find("axis")
        axis = self.file.numbers(None if stated is None else stated.get("xyz"), 3, f"axis of joint `{name}`", [1.0, 0.0, 0.0])
        if not np.any(axis):
            raise self.file.fault(f"axis of joint `{name}` is zero, expected a direction")
        dynamics = joint.find("dynamics")
        damping = 0.0 if dynamics is None else self.file.number(dynamics.get("damping"), f"damping of joint `{name}`", 0.0)
        if dynamics is not None and self.file.number(dynamics.get("friction"), f"friction of joint `{name}`", 0.0):
            self.file.refuse("friction", f"the friction of joint `{name}`", "state a smooth torque in `loads` of a subclass")
        limit = joint.find("limit") if given in ("revolute", "prismatic") else None
        low, high = (0.0 if limit is None else self.file.number(limit.get(which), f"limit of joint `{name}`", 0.0) for which in ("lower", "upper"))
        if damping < 0:
            raise self.file.fault(f"damping of joint `{name}` is {damping:g}, expected a number >= 0")
        return Joint(name, kind, axis / np.linalg.norm(axis), damping=damping, limits=(low, high) if low < high else None)

    def _follower(self, joint: Element, names: list[str]) -> Follower:
        mimic, name = joint.find("mimic"), joint.get("name") or ""
        assert mimic is not None
        leader = mimic.get("joint") or ""
        for end in (name, leader):
            if end not in names:
                raise self.file.fault(f"`mimic` of joint `{name}`: `{end}` is no joint of one coordinate; {nearest(end, names)}")
        if leader == name:
            raise self.file.fault(f"joint `{name}` mimics itself; expected another joint")
        factor = self.file.number(mimic.get("multiplier"), f"multiplier of joint `{name}`", 1.0)
        return Follower(name, leader, (self.file.number(mimic.get("offset"), f"offset of joint `{name}`", 0.0), factor))

    def _origin(self, element: Element, what: str) -> tuple[Vector, Matrix]:
        origin = element.find("origin")
        xyz, rpy = (None, None) if origin is None else (origin.get("xyz"), origin.get("rpy"))
        zero = np.zeros(3)
        return self.file.numbers(xyz, 3, f"xyz of {what}", zero), by_roll_pitch_yaw(self.file.numbers(rpy, 3, f"rpy of {what}", zero))

    def _content(self, name: str) -> tuple[Mass | None, tuple[Look, ...]]:
        """Mass and shapes of a link."""
        link = self.links[name]
        looks = [self._look(visual, f"visual of link `{name}`") for visual in link.findall("visual")]
        return self._mass(link, name), tuple(look for look in looks if look is not None)

    def _mass(self, link: Element, name: str) -> Mass | None:
        inertial = link.find("inertial")
        if inertial is None:
            return None
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is None or inertia is None:
            raise self.file.fault(f"link `{name}` has an `inertial` without `{'mass' if mass is None else 'inertia'}`; give both")
        m = self.file.number(mass.get("value"), f"mass of link `{name}`")
        centre, turn = self._origin(inertial, f"`inertial` of link `{name}`")
        xx, xy, xz, yy, yz, zz = (self.file.number(inertia.get(f"i{axes}"), f"i{axes} of link `{name}`") for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
        matrix = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        if m == 0 and not np.any(matrix):
            return None
        if not m > 0:
            raise self.file.fault(f"mass of link `{name}` is {m:g}, expected a number above zero")
        return Mass(m, centre, matrix)

    def _look(self, visual: Element, what: str) -> Look | None:
        geometry = visual.find("geometry")
        if geometry is None or len(geometry) != 1:
            raise self.file.fault(f"{what} has {'no shape' if not geometry else 'several shapes'} in its `geometry`, expected one")
        (shape,) = geometry
        position, turn = self._origin(visual, what)
        colour, opacity = self._colour(visual)
        if opacity == 0:
            return None
        if shape.tag == "box":
            return Look("box", tuple(self.file.numbers(shape.get("size"), 3, f"size of {what}")), position, turn, colour, opacity)
        if shape.tag == "sphere":
            return Look("ball", (self.file.number(shape.get("radius"), f"radius of {what}"),), position, turn, colour, opacity)
        if shape.tag in ("cylinder", "capsule"):
            size = tuple(self.file.number(shape.get(word), f"{word} of {what}") for word in ("radius", "length"))
            return Look(shape.tag, size, position, turn, colour, opacity)
        path = self._mesh_path(shape.get("filename"))
        if path is None:
            if shape.tag == "mesh":
                self.file.leave_out(f"mesh {shape.get('filename')}")
            return None
        return Look("mesh", tuple(self.file.numbers(shape.get("scale"), 3, f"scale of {what}", [1.0] * 3)), position, turn, colour, opacity, str(path))

    def _mesh_path(self, name: str | None) -> Path | None:
        """The file of a mesh, if it is there."""
        if not name:
            return None
        if name.startswith("package://"):
            package, _, rest = name.removeprefix("package://").partition("/")
            folders = (
                [Path(self.packages[package])] if package in self.packages else [above / package for above in (self.file.folder, *self.file.folder.parents)]
            )
            folders += [above for above in self.file.folder.parents if above.name == package]
        else:
            folders, rest = [self.file.folder], name.removeprefix("file://")
        return next((folder / rest for folder in folders if os.path.isfile(folder / rest)), None)

    def _colour(self, visual: Element) -> tuple[str | None, float]:
        material = visual.find("material")
        if material is None:
            return None, 1.0
        colour = material.find("color")
        if colour is None:
            known = self.colours.get(material.get("name"))
            colour = None if known is None else known.find("color")
        if colour is None:
            return None, 1.0
        return colour_of(self.file.numbers(colour.get("rgba"), 4, "rgba of a material"))


def colour_of(rgba) -> tuple[str, float]:
    """Colour and opacity as `jj.Visual` takes them."""
    levels = [round(255 * min(max(x, 0.0), 1.0)) for x in rgba[:3]]
    return "#{:02x}{:02x}{:02x}".format(*levels), min(max(float(rgba[3]), 0.0), 1.0)
