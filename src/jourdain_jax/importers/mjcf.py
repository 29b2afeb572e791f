"""Scenes from MJCF files, the format of MuJoCo: bodies, joints, inertias, shapes, motors of joints.

Source: the XML reference of MuJoCo's documentation, version 3.
"""

import math
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jourdain_jax.calculus.rotations import matrices_to_quaternions, onto_axis
from jourdain_jax.importers.mjcf_elements import TABLE, Defaults, all_of
from jourdain_jax.importers.placement import (
    SIZES,
    about,
    by_euler_angles,
    by_quaternion,
    combined,
    moments,
    volume,
)
from jourdain_jax.importers.scene_class import identifier
from jourdain_jax.importers.tree import (
    Closure,
    Follower,
    Joint,
    Link,
    Look,
    Mass,
    Matrix,
    Motor,
    Push,
    Tree,
    Vector,
)
from jourdain_jax.importers.tree_scene import tree_scene
from jourdain_jax.importers.xml_file import Element, Part, XmlFile
from jourdain_jax.scene.names import Labels, as_labels, nearest
from jourdain_jax.scene.scene import Scene

Place = tuple[Vector, Matrix]  # position and rotation
Geom = tuple[Part, str, Place]  # attributes, type, and frame relative to the body
HERE = np.zeros(3), np.eye(3)
_TYPES = ("free", "ball", "slide", "hinge")
_ATTITUDE = tuple(f"attitude_{part}" for part in "wxyz")
_TURNS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}  # attribute -> count of numbers
# shape for drawing, and factors of the sizes
_LOOKS: dict = {"sphere": ("ball", 1), "ellipsoid": ("ellipsoid", 1), "box": ("box", 2)}
_LOOKS |= {kind: (kind, [1, 2]) for kind in ("capsule", "cylinder")}


def from_mjcf(path, *, free: Iterable[str] = (), ignore: Iterable[str] = ()) -> type[Scene]:
    """Return a class of scenes from an MJCF file: its bodies, joints, inertias, springs, dampers and motors.

        Arm = jj.from_mjcf("arm.xml", ignore=("armature",))
        jj.simulate(Arm(), {"elbow": 0.3}, t1=1.0)

    - `path`: of the file, or its text.
    - `free`: names of bodies whose position in the parent's frame becomes a parameter.
    - `ignore`: names of elements and attributes to omit although they change the motion, such as "armature"
      or "equality". With "inertia", impossible moments of inertia are accepted.

    **Returns** a class. Hinges and slides are coordinates with their names, a ball joint is a quaternion with
    its name, and a free joint is `<joint>_x`, `_y`, `_z` and the quaternion `<joint>_attitude`. Joints
    without a name are called `<body>_joint`, with a number from the second on. Speeds are those of MuJoCo.
    Motors of joints and of sites are inputs; as in MuJoCo, `ctrlrange` limits the input and `forcerange` its
    force. Nonzero values of the file are fields: `<body>_mass` (kg), `<body>_mass_centre` (m, in the body's
    frame), `<body>_inertia` (kg m^2, about the mass centre), `<joint>_damping`, `<joint>_stiffness` and
    `gravity` (m/s^2), and `<body>_origin` (m) of bodies in `free`. Inertias of geoms come from their mass or
    density. The pose of the file is the `example`.

    `connect`, `weld` and `joint` of `equality` become exact geometric constraints: loops are closed as in the
    stated pose.

    Geoms are drawn, but their contacts are not read: state rolling in `contacts` of a subclass. Limits of
    joints do not stop a motion; they become the `domain`.

    **Raises** ValueError, with the name, for an unreadable file, a moving body without mass, impossible
    moments of inertia and repeated statements. Contents that change the motion and are not supported also
    raise it, as do unknown ones, such as `tendon`, `armature`, `frictionloss` or a misspelt attribute, unless
    `ignore` names them. A warning lists other omitted elements.
    """
    file = XmlFile(path, TABLE, "MJCF", ignore)
    tree = _Reader(file).tree(as_labels(free))
    file.warn()
    return tree_scene(tree, file.source, file.ignore)


class _Reader:
    """Reader of one file."""

    def __init__(self, file: XmlFile):
        self.file, self.defaults, self.compiler = file, Defaults(file), all_of(file, "compiler")
        self.settings = {
            "angle": "degree",
            "eulerseq": "xyz",
            "inertiafromgeom": "auto",
            "autolimits": "true",
        } | dict(self.compiler.given)
        self.unit = 1.0 if self.settings["angle"] == "radian" else math.pi / 180
        if len(self.settings["eulerseq"]) != 3 or set(self.settings["eulerseq"].lower()) - set("xyz"):
            raise self.compiler.fault(
                "`eulerseq`", f"`{self.settings['eulerseq']}`, expected three letters out of x, y, z, X, Y, Z"
            )
        self.meshes = {
            mesh.get("name") or Path(mesh.get("file", "")).stem: mesh
            for mesh in file.root.findall("asset/mesh")
        }
        self.links: list[Link] = []
        # site -> its body, and its position and rotation there
        self.sites: dict[str, tuple[str | None, Vector, Matrix]] = {}
        self.moving: set[str | None] = set()  # names of links
        self.start: dict[str, float] = {}

    def tree(self, free: Labels) -> Tree:
        """Return the mechanism."""
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
        name, motors, ties = (
            self.file.root.get("model") or "Mjcf",
            tuple(self._motors(joints)),
            tuple(self._ties(joints)),
        )
        return Tree(name, tuple(self.links), gravity, motors, ties, free, self.start)

    def _ties(self, joints: list[str]) -> Iterable[Follower | Closure]:
        """Yield the exact constraints that `equality` states."""
        stated = () if "equality" in self.file.ignore else self.file.root.findall("equality/*")
        for k, element in enumerate(stated):
            tie, follows = (
                Part(self.file, f"{element.tag} {k + 1} of `equality`", element),
                element.tag == "joint",
            )
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
            elif element.tag == "weld":  # its anchor is a point of the second body
                yield Closure(
                    element.get("name") or tie.what, other, one, tie.numbers("anchor", 3, np.zeros(3)), True
                )
            else:
                yield Closure(element.get("name") or tie.what, one, other, tie.numbers("anchor", 3), False)

    def _children(self, holder: Element, parent: str | None, childclass: str | None) -> None:
        for site, given, frame in self._held(holder, "site", childclass):
            self.sites[site.get("name", "")] = (
                parent,
                *_within(frame, self._place(self.defaults.of(site, given, f"site `{site.get('name')}`"))),
            )
        for element, given, frame in self._held(holder, "body", childclass):
            self._body(element, parent, given, frame)

    def _held(
        self, holder: Element, kind: str, childclass: str | None, frame: Place = HERE
    ) -> Iterable[tuple[Element, str | None, Place]]:
        """Yield the elements of a kind in a body and in its nested frames, each with its default class and
        its frame relative to the body.
        """
        for child in holder:
            if child.tag == kind:
                yield child, childclass, frame
            elif child.tag == "frame":
                inner = _within(frame, self._place(Part(self.file, f"frame `{child.get('name')}`", child)))
                yield from self._held(child, kind, child.get("childclass") or childclass, inner)

    def _body(self, body: Element, parent: str | None, childclass: str | None, frame: Place) -> None:
        name = body.get("name") or f"body{len(self.links)}"
        what, childclass = f"body `{name}`", body.get("childclass") or childclass
        part = Part(self.file, what, body)
        position, turn = _within(frame, self._place(part))
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
        mass = self._mass(part, geoms) if moves else None  # parts that never move need no mass
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
        axis, anchor, limits = (
            given.direction("axis", [0.0, 0.0, 1.0]),
            given.numbers("pos", 3, np.zeros(3)),
            (float(low), float(high)) if low < high else None,
        )
        return Joint(name, kind, axis, anchor, reference * unit, damping, stiffness, rest * unit, limits)

    def _mass(self, body: Part, geoms: list[Geom]) -> Mass | None:
        rule = self.settings["inertiafromgeom"]
        if body.children("inertial") and rule != "true":
            return self._stated_mass(body.child("inertial"))
        masses = [] if rule == "false" else [self._mass_of_geom(*geom) for geom in geoms]
        heavy = [mass for mass in masses if mass is not None]
        return combined(heavy) if heavy else None

    def _stated_mass(self, inertial: Part) -> Mass | None:
        position, turn = self._place(inertial)
        if "fullinertia" in inertial:
            xx, yy, zz, xy, xz, yz = inertial.numbers("fullinertia", 6)
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        elif "diaginertia" in inertial:
            inertia = np.diag(inertial.numbers("diaginertia", 3))
        else:
            raise self.file.fault(f"{inertial.what} has neither `diaginertia` nor `fullinertia`; give one")
        return inertial.mass(inertial.number("mass"), position, turn @ inertia @ turn.T, moved=True)

    def _geoms(self, holder: Element, childclass: str | None, where: str) -> list[Geom]:
        found = []
        for geom, around, frame in self._held(holder, "geom", childclass):
            given = self.defaults.of(
                geom,
                around,
                f"geom `{geom.get('name')}` of {where}" if geom.get("name") else f"a geom of {where}",
            )
            found.append((given, given.given.get("type", "mesh" if "mesh" in given else "sphere"), frame))
        return found

    def _mass_of_geom(self, given: Part, kind: str, frame: Place) -> Mass | None:
        word = "mass" if "mass" in given else "density"
        number = given.number(word, 1000.0)  # kg/m^3, for geoms that state neither
        if number < 0:
            raise given.fault(word, f"{number:g}, expected a number that is not negative")
        if number == 0:
            return None
        if kind not in SIZES:
            self.file.refuse(
                kind,
                f"the mass of {given.what}, of the type `{kind}`,",
                'give the body an `inertial`, or the geom mass="0"',
            )
            return None
        position, turn, size = self._solid(given, kind, frame)
        mass = number if word == "mass" else number * volume(kind, size)
        return Mass(mass, position, turn @ np.diag(mass * moments(kind, size)) @ turn.T)

    def _solid(self, given: Part, kind: str, frame: Place) -> tuple[Vector, Matrix, np.ndarray]:
        """Return centre, axes and size of a geom."""
        position, turn = self._place(given)
        size = given.numbers("size", None)
        if "fromto" in given and kind != "sphere":
            ends = given.numbers("fromto", 6)
            along = ends[3:] - ends[:3]
            half = np.linalg.norm(along) / 2
            position, turn = (ends[:3] + ends[3:]) / 2, onto_axis(along)
            size = np.array([size[0], half] if kind in ("capsule", "cylinder") else [size[0], size[0], half])
        if len(size) < SIZES[kind] or np.any(size[: SIZES[kind]] <= 0):
            raise given.fault(
                "size",
                f"`{given.given.get('size')}`, expected {SIZES[kind]} lengths above "
                f"zero for the type `{kind}`",
            )
        return *_within(frame, (position, turn)), size[: SIZES[kind]]

    def _looks(self, geoms: list[Geom]) -> tuple[Look, ...]:
        return tuple(look for look in (self._look(*geom) for geom in geoms) if look is not None)

    def _look(self, given: Part, kind: str, frame: Place) -> Look | None:
        colour, opacity = given.colour()
        if opacity == 0:
            return None
        if kind in _LOOKS:
            look, factors = _LOOKS[kind]
            position, turn, size = self._solid(given, kind, frame)
            return Look(look, tuple(map(float, size * factors)), position, turn, colour, opacity)
        if kind == "mesh" and given.given.get("mesh") in self.meshes:
            mesh = Part(self.file, f"the mesh of {given.what}", self.meshes[given.given["mesh"]])
            path = (
                self.file.folder
                / self.settings.get("meshdir", self.settings.get("assetdir", ""))
                / mesh.given.get("file", "")
            )
            if os.path.isfile(path):
                return Look(
                    "mesh",
                    tuple(mesh.numbers("scale", 3, [1.0] * 3)),
                    *_within(frame, self._place(given)),
                    colour,
                    opacity,
                    str(path),
                )
        self.file.leave_out(f"geom of type {kind}")
        return None

    def _place(self, given: Part) -> Place:
        """Return position and rotation from attributes. Raises ValueError for several rotations, and for
        numbers that define none.
        """
        position = given.numbers("pos", 3, np.zeros(3))
        stated = [word for word in _TURNS if word in given]
        if not stated:
            return position, np.eye(3)
        if len(stated) > 1:
            raise self.file.fault(
                f"{given.what} is rotated by {' and by '.join(f'`{word}`' for word in stated)}; expected one "
                "of them"
            )
        (word,) = stated
        with np.errstate(invalid="ignore"):
            turn = self._turn(word, given.numbers(word, _TURNS[word]))
        if not np.all(np.isfinite(turn)):
            raise given.fault(word, f"`{given.given[word]}`, which is not a rotation")
        return position, turn

    def _turn(self, word: str, x: np.ndarray) -> Matrix:
        """Return the rotation that the numbers of an attribute define; NaN if they define none."""
        if word == "quat":
            return by_quaternion(x)
        if word == "axisangle":
            return about(x[:3] / np.linalg.norm(x[:3]), x[3] * self.unit)
        if word == "euler":
            return by_euler_angles(x * self.unit, self.settings["eulerseq"])
        if word == "zaxis":
            return onto_axis(x)
        along = x[:3] / np.linalg.norm(x[:3])
        across = x[3:] - (along @ x[3:]) * along
        across = across / np.linalg.norm(across)
        return np.stack([along, across, np.cross(along, across)], axis=1)

    def _motors(self, names: list[str]) -> Iterable[Motor]:
        heavy = {link.name for link in self.links if link.mass is not None}
        for k, element in enumerate(self.file.root.findall("actuator/motor")):
            motor = self.defaults.of(element, None, f"motor `{element.get('name') or k + 1}`")
            joint, site = motor.given.get("joint", ""), motor.given.get("site")
            name, gear, push = (
                element.get("name") or f"{site or joint}_motor",
                motor.numbers("gear", None, [1.0]),
                None,
            )
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
        """Return the range that limits a motor's control or force; None if there is none or it is switched
        off.
        """
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


def _within(frame: Place, inner: Place) -> Place:
    """Return a place in a frame as a place in the frame's parent."""
    return frame[0] + frame[1] @ inner[0], frame[1] @ inner[1]
