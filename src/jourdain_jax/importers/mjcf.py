"""Scenes from MJCF files, the format of MuJoCo: bodies, joints, inertias, shapes, motors of joints.

Source: the XML reference of MuJoCo's documentation, version 3.
"""

from collections.abc import Iterable

import numpy as np

from jourdain_jax.calculus.files import FilePath
from jourdain_jax.calculus.rotations import matrices_to_quaternions
from jourdain_jax.importers.mjcf_elements import TABLE, all_of
from jourdain_jax.importers.mjcf_geoms import GeomReader, Place, within
from jourdain_jax.importers.scene_class import identifier
from jourdain_jax.importers.tree import Closure, Follower, Joint, Link, Matrix, Motor, Push, Tree, Vector
from jourdain_jax.importers.tree_scene import tree_scene
from jourdain_jax.importers.xml_file import Element, Part, XmlFile
from jourdain_jax.scene.coordinates import Labels, as_labels, nearest
from jourdain_jax.scene.scene import Scene

_TYPES = ("free", "ball", "slide", "hinge")
_ATTITUDE = tuple(f"attitude_{part}" for part in "wxyz")


def from_mjcf(path: FilePath, *, free: Iterable[str] = (), ignore: Iterable[str] = ()) -> type[Scene]:
    """Return a class of scenes from an MJCF file: its bodies, joints, inertias, springs, dampers and motors.

        Arm = jj.from_mjcf("arm.xml", ignore=("armature",))
        jj.simulate(Arm(), {"elbow": 0.3}, t1=1.0)

    - `path`: path of the file, or its text.
    - `free`: names of bodies whose position in the parent's frame becomes a parameter.
    - `ignore`: names of elements and attributes to omit although they change the motion, such as "armature"
      or "equality". With "inertia", impossible moments of inertia are read; motions refuse them until
      `replace` gives others.

    **Returns** a class. Hinges and slides are coordinates with their names. A ball joint is a quaternion with
    its name; a free joint is `<joint>_x`, `_y`, `_z` and the quaternion `<joint>_attitude`. Joints without a
    name are called `<body>_joint`, the second and later ones with a number. Speeds are defined as in MuJoCo.
    Motors of joints and of sites are inputs; as in MuJoCo, `ctrlrange` limits the input and `forcerange` its
    force. Nonzero values of the file are fields: `<body>_mass` (kg), `<body>_mass_centre` (m, in the body's
    frame), `<body>_inertia` (kg m^2, about the mass centre), `<joint>_damping`, `<joint>_stiffness` and
    `gravity` (m/s^2), and `<body>_origin` (m) of bodies in `free`. Inertias of geoms come from their mass or
    density. The pose of the file is the `example`.

    `connect`, `weld` and `joint` of `equality` become exact geometric constraints, so that loops are closed
    as in the pose of the file.

    Geoms are drawn, but their contacts are not imported: add rolling in `contacts` of a subclass. Limits of
    joints do not stop a motion; they become the `domain`.

    **Raises** ValueError, which names the part, for an unreadable file, a moving body without mass,
    impossible moments of inertia, and repeated definitions. Unknown contents, such as a misspelt attribute,
    and unsupported contents that change the motion, such as `tendon`, `armature` or `frictionloss`, also
    raise it, unless `ignore` names them. A warning lists other omitted elements.
    """
    file = XmlFile(path, TABLE, "MJCF", ignore)
    tree = _Reader(file).tree(as_labels(free))
    file.warn()
    return tree_scene(tree, file.source, file.ignore)


class _Reader(GeomReader):
    """Reader of one file."""

    def __init__(self, file: XmlFile):
        super().__init__(file)
        self.links: list[Link] = []
        # site -> its body, and its position and rotation in that body
        self.sites: dict[str, tuple[str | None, Vector, Matrix]] = {}
        self.moving: set[str | None] = set()  # names of links
        self.start: dict[str, float] = {}

    def tree(self, free: Labels) -> Tree:
        """Return the mechanism in the file."""
        for section in self.file.root.findall("worldbody"):
            name = "world" if not self.links else f"world {len(self.links) + 1}"
            looks = self._looks(self._geoms(section, None, "the world"))
            self.links.append(Link(name, None, np.zeros(3), np.eye(3), looks=looks))
            self._children(section, None, None)
        gravity = all_of(self.file, "option").numbers("gravity", 3, [0.0, 0.0, -9.81])
        if any(flag.get("gravity") == "disable" for flag in self.file.root.findall("option/flag")):
            gravity = np.zeros(3)
        joints = [
            joint.name for link in self.links for joint in link.joints if joint.kind in ("hinge", "slide")
        ]
        name = self.file.root.get("model") or "Mjcf"
        motors = tuple(self._motors(joints))
        ties = tuple(self._ties(joints))
        return Tree(name, tuple(self.links), gravity, motors, ties, free, self.start)

    def _ties(self, joints: list[str]) -> Iterable[Follower | Closure]:
        """Yield the exact constraints that `equality` states."""
        stated = () if "equality" in self.file.ignore else self.file.root.findall("equality/*")
        for k, element in enumerate(stated):
            tie = Part(self.file, f"{element.tag} {k + 1} of `equality`", element)
            follows = element.tag == "joint"
            one, other = (element.get(f"{'joint' if follows else 'body'}{end}") for end in (1, 2))
            known = joints if follows else [link.name for link in self.links]
            for end in (one, other or one):
                self.file.check_name(
                    str(end),
                    known,
                    f"{tie.what} names `{end}`, which is not a {'hinge or slide' if follows else 'body'}",
                )
            if element.get("active") == "false":
                continue
            if follows:
                yield Follower(one or "", other or "", tuple(tie.numbers("polycoef", None, [0.0, 1.0])))
            elif element.tag == "weld":  # the anchor is a point of the second body
                yield Closure(
                    element.get("name") or tie.what, other, one, tie.numbers("anchor", 3, np.zeros(3)), True
                )
            else:
                yield Closure(element.get("name") or tie.what, one, other, tie.numbers("anchor", 3), False)

    def _children(self, holder: Element, parent: str | None, childclass: str | None) -> None:
        for site, given, frame in self._held(holder, "site", childclass):
            self.sites[site.get("name", "")] = (
                parent,
                *within(frame, self._place(self.defaults.of(site, given, f"site `{site.get('name')}`"))),
            )
        for element, given, frame in self._held(holder, "body", childclass):
            self._body(element, parent, given, frame)

    def _body(self, body: Element, parent: str | None, childclass: str | None, frame: Place) -> None:
        name = body.get("name") or f"body{len(self.links)}"
        what, childclass = f"body `{name}`", body.get("childclass") or childclass
        part = Part(self.file, what, body)
        position, turn = within(frame, self._place(part))
        joints = tuple(
            self._joint(element, childclass, name, k)
            for k, element in enumerate(part.children("joint", "freejoint"))
        )
        if any(joint.kind == "free" for joint in joints):
            if parent is not None or len(joints) > 1:
                raise self.file.fault(
                    f"{what} has a free joint and {'a parent' if parent else 'other joints'}; "
                    "a free joint must be the only joint of a body that is directly in `worldbody`"
                )
            start = (
                *zip("xyz", position, strict=True),
                *zip(_ATTITUDE, matrices_to_quaternions(turn[None])[0], strict=True),
            )
            self.start |= {
                f"{identifier(joints[0].name)}_{part}": float(x) for part, x in start
            }  # the stated pose
            position, turn = np.zeros(3), np.eye(3)
        moves = bool(joints) or parent in self.moving
        if moves:
            self.moving.add(name)
        geoms = self._geoms(body, childclass, what)
        mass = self._mass(part, geoms) if moves else None  # fixed bodies need no mass
        self.links.append(Link(name, parent, position, turn, joints, mass, self._looks(geoms)))
        self._children(body, name, childclass)

    def _joint(self, element: Element, childclass: str | None, body: str, number: int) -> Joint:
        name = element.get("name") or (f"{body}_joint" if number == 0 else f"{body}_joint{number + 1}")
        what = f"joint `{name}`"
        given = (
            Part(self.file, what, element)
            if element.tag == "freejoint"
            else self.defaults.of(element, childclass, what)
        )
        kind = "free" if element.tag == "freejoint" else given.given.get("type", "hinge")
        self.file.check_name(kind, _TYPES, f"{what} is of the type `{kind}`")
        unit = self.unit if kind in ("hinge", "ball") else 1.0
        damping, stiffness, rest, reference = (
            given.number(word, 0.0) for word in ("damping", "stiffness", "springref", "ref")
        )
        if stiffness and kind not in ("hinge", "slide"):
            self.file.refuse("stiffness", f"the stiffness of the {kind} {what}")
            stiffness = 0.0
        low, high = given.numbers("range", 2, [0.0, 0.0]) * unit
        if reference and kind in ("hinge", "slide"):
            self.start[identifier(name)] = reference * unit
        axis = given.direction("axis", [0.0, 0.0, 1.0])
        anchor = given.numbers("pos", 3, np.zeros(3))
        limits = (float(low), float(high)) if low < high else None
        return Joint(name, kind, axis, anchor, reference * unit, damping, stiffness, rest * unit, limits)

    def _motors(self, names: list[str]) -> Iterable[Motor]:
        heavy = {link.name for link in self.links if link.mass is not None}
        for k, element in enumerate(self.file.root.findall("actuator/motor")):
            motor = self.defaults.of(element, None, f"motor `{element.get('name') or k + 1}`")
            joint, site = motor.given.get("joint", ""), motor.given.get("site")
            name = element.get("name") or f"{site or joint}_motor"
            gear = motor.numbers("gear", None, [1.0])
            push = None
            motor.what = f"motor `{name}`"
            if site is not None:
                self.file.check_name(site, self.sites, f"{motor.what} pushes the unknown site `{site}`")
                link, position, turn = self.sites[site]
                if link not in heavy:
                    raise self.file.fault(
                        f"{motor.what} pushes the site `{site}` of "
                        f"{f'body `{link}`' if link else 'the world'}, which has no moving mass"
                    )
                force, moment = np.pad(gear, (0, 6 - len(gear))).reshape(2, 3) @ turn.T
                gear, push = np.ones(1), Push(link, position, force, moment)
            elif joint not in names:
                raise self.file.fault(
                    f"{motor.what} pushes `{joint}`, which is not a hinge or slide; {nearest(joint, names)}"
                )
            yield Motor(
                name, joint, float(gear[0]), self._limits(motor, "ctrl"), self._limits(motor, "force"), push
            )

    def _limits(self, motor: Part, what: str) -> tuple[float, float] | None:
        """Return the range of a motor's control or force; None if it has no limit."""
        low, high = motor.numbers(f"{what}range", 2, [0.0, 0.0])
        limited, inferred = motor.given.get(f"{what}limited", "auto"), self.settings["autolimits"] == "true"
        if (limited == "true" and low >= high) or (
            limited == "auto" and not inferred and (low, high) != (0.0, 0.0)
        ):
            raise self.file.fault(
                f"`{what}range` of {motor.what} and `{what}limited` contradict each other; "
                f'state low < high and `{what}limited="true"`'
            )
        return (float(low), float(high)) if limited == "true" or (limited == "auto" and low < high) else None
