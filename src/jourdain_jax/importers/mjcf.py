"""Scenes from MJCF files, the format of MuJoCo: bodies, joints, inertias, shapes, motors of joints.

Source: the XML reference of MuJoCo's documentation, version 3.
"""

import math
import os
from collections.abc import Iterable

import numpy as np

from jourdain_jax.calculus.rotations import matrices_to_quaternions
from jourdain_jax.importers.identifiers import identifier
from jourdain_jax.importers.mjcf_elements import TABLE, Defaults, attributes_of
from jourdain_jax.importers.placing import about, by_euler_angles, by_quaternion, combined, onto_axis
from jourdain_jax.importers.solids import SIZES, moments, volume
from jourdain_jax.importers.tree import Closure, Follower, Joint, Link, Look, Mass, Matrix, Motor, Tree, Vector
from jourdain_jax.importers.tree_scene import tree_scene
from jourdain_jax.importers.urdf import colour_of
from jourdain_jax.importers.xml_file import Element, XmlFile
from jourdain_jax.scene.names import as_labels, nearest
from jourdain_jax.scene.scene import Scene

_TYPES = ("free", "ball", "slide", "hinge")
_LOOKS = {"sphere": "ball", "capsule": "capsule", "cylinder": "cylinder", "box": "box", "ellipsoid": "ellipsoid"}


def from_mjcf(path, *, free: Iterable[str] = (), ignore: Iterable[str] = ()) -> type[Scene]:
    """A class of scenes from an MJCF file: its bodies, joints, inertias, springs, dampers and motors.

        Arm = jj.from_mjcf("arm.xml", ignore=("armature",))
        jj.simulate(Arm(), {"elbow": 0.3}, t1=1.0)

    - `path`: of the file, or its text.
    - `free`: names of bodies whose place in the frame of their parent is a parameter.
    - `ignore`: names of elements and attributes that may be left out although they change the motion, such as "armature" or "equality". With
      "inertia", moments of inertia that no body has are taken as they are.

    **Returns** a class. Hinges and slides are coordinates of their own names, a ball joint is a quaternion of its name, a free one `<joint>_x`, `_y`, `_z` and
    the quaternion `<joint>_attitude`; joints without a name are called `<body>_joint`, with a number from the second on. Speeds are those of MuJoCo. Motors
    are inputs, held within `ctrlrange` and their force within `forcerange` where these are limits, as MuJoCo holds them. Fields, as far as they are not
    zero: `<body>_mass` (kg), `<body>_mass_centre` (m, in the body's frame), `<body>_inertia` (kg m^2, about the mass centre), `<joint>_damping`,
    `<joint>_stiffness` and `gravity` (m/s^2); and of bodies that `free` names `<body>_origin` (m). Inertias of geoms come from their mass or density. The pose
    that the file states is the `example`.

    `connect`, `weld` and `joint` of `equality` are geometric rows, which hold exactly: loops are closed as they are in the stated pose.

    Geoms are drawn; what they touch is not read: rolling is stated in `contacts` of a subclass. Limits stop nothing; those of joints become the `domain`.

    **Raises** ValueError, by name: a file that cannot be read, a body that moves and has no mass, moments of inertia that no body has, what is said twice, and
    whatever changes the motion, or is no part of the format, and is not read, such as `tendon`, `armature`, `frictionloss` or a misspelt attribute,
    unless `ignore` names it. A warning lists what else is left out.
    """
    file = XmlFile(path, TABLE, "MJCF", ignore)
    tree = _Reader(file).tree(as_labels(free))
    file.warn()
    return tree_scene(tree, file.source, file.ignore)


class _Reader:
    """Reads the elements of one file."""

    def __init__(self, file: XmlFile):
        self.file, self.defaults = file, Defaults(file)
        self.compiler, self.option = attributes_of(file, "compiler"), attributes_of(file, "option")
        self.unit = 1.0 if self.compiler.get("angle") == "radian" else math.pi / 180
        self.sequence = self.compiler.get("eulerseq", "xyz")
        if len(self.sequence) != 3 or set(self.sequence.lower()) - set("xyz"):
            raise file.fault(f"`eulerseq` of `compiler` is `{self.sequence}`, expected three letters out of x, y, z, X, Y, Z")
        self.meshes = {mesh.get("name") or (mesh.get("file") or "").rpartition("/")[2].partition(".")[0]: mesh for mesh in file.root.findall("asset/mesh")}
        self.links: list[Link] = []
        self.moving: set[str | None] = set()  # names of links
        self.start: dict[str, float] = {}

    def tree(self, free: tuple[str, ...]) -> Tree:
        """The whole mechanism."""
        for section in self.file.root.findall("worldbody"):
            looks = self._looks(section, None, "the world")
            self.links.append(Link("world" if not self.links else f"world {len(self.links) + 1}", None, np.zeros(3), np.eye(3), looks=looks))
            self._children(section, None, None)
        gravity = self.file.numbers(self.option.get("gravity"), 3, "`gravity`", [0.0, 0.0, -9.81])
        if any(flag.get("gravity") == "disable" for flag in self.file.root.findall("option/flag")):
            gravity = np.zeros(3)
        joints = [joint.name for link in self.links for joint in link.joints if joint.kind in ("hinge", "slide")]
        name, motors, ties = self.file.root.get("model") or "Mjcf", tuple(self._motors(joints)), tuple(self._ties(joints))
        return Tree(name, tuple(self.links), gravity, motors, ties, free, self.start)

    def _ties(self, joints: list[str]) -> Iterable[Follower | Closure]:
        """What `equality` states, as rows that hold exactly."""
        stated = () if "equality" in self.file.ignore else self.file.root.findall("equality/*")
        for k, element in enumerate(stated):
            what, follows = f"{element.tag} {k + 1} of `equality`", element.tag == "joint"
            ends = [element.get(f"{'joint' if follows else 'body'}{end}") for end in (1, 2)]
            known = joints if follows else [link.name for link in self.links]
            for end in (ends[0], ends[1] or ends[0]):
                if end not in known:
                    raise self.file.fault(f"{what} names `{end}`, which is no {'hinge or slide' if follows else 'body'}; {nearest(str(end), known)}")
            if element.get("active") == "false":
                continue
            if follows:
                coefficients = self.file.numbers(element.get("polycoef"), None, f"polycoef of {what}", [0.0, 1.0])
                yield Follower(ends[0] or "", ends[1] or "", tuple(coefficients))
            else:  # the anchor of a weld is a point of the second body
                weld = element.tag == "weld"
                link, other = ends[::-1] if weld else ends
                anchor = self.file.numbers(element.get("anchor"), 3, f"anchor of {what}", np.zeros(3) if weld else None)
                yield Closure(element.get("name") or what, link, other, anchor, weld)

    def _children(self, holder: Element, parent: str | None, childclass: str | None) -> None:
        for element in holder.findall("body"):
            self._body(element, parent, childclass)

    def _body(self, body: Element, parent: str | None, childclass: str | None) -> None:
        name = body.get("name") or f"body{len(self.links)}"
        childclass = body.get("childclass") or childclass
        position, turn = self._place(dict(body.attrib), f"body `{name}`")
        given = [element for element in body if element.tag in ("joint", "freejoint")]
        joints = tuple(self._joint(element, childclass, name, k) for k, element in enumerate(given))
        if any(joint.kind == "free" for joint in joints):
            if parent is not None or len(joints) > 1:
                raise self.file.fault(f"body `{name}` has a free joint and {'a parent' if parent else 'others'}; expected it alone, in the world")
            self._free_start(joints[0], position, turn)
            position, turn = np.zeros(3), np.eye(3)
        moves = bool(joints) or parent in self.moving
        if moves:
            self.moving.add(name)
        mass = self._mass(body, childclass, name) if moves else None  # what never moves needs none
        self.links.append(Link(name, parent, position, turn, joints, mass, self._looks(body, childclass, f"body `{name}`")))
        self._children(body, name, childclass)

    def _free_start(self, joint: Joint, position: Vector, turn: Matrix) -> None:
        """The stated pose as the start."""
        name = identifier(joint.name)
        self.start |= {f"{name}_{axis}": float(x) for axis, x in zip("xyz", position, strict=True)}
        self.start |= {f"{name}_attitude_{part}": float(x) for part, x in zip("wxyz", matrices_to_quaternions(turn[None])[0], strict=True)}

    def _joint(self, element: Element, childclass: str | None, body: str, number: int) -> Joint:
        name = element.get("name") or (f"{body}_joint" if number == 0 else f"{body}_joint{number + 1}")
        what = f"joint `{name}`"
        given = dict(element.attrib) if element.tag == "freejoint" else self.defaults.of(element, childclass, what)
        kind = "free" if element.tag == "freejoint" else given.get("type", "hinge")
        if kind not in _TYPES:
            raise self.file.fault(f"{what} is of the type `{kind}`; {nearest(kind, _TYPES)}")
        axis = self.file.numbers(given.get("axis"), 3, f"axis of {what}", [0.0, 0.0, 1.0])
        if not np.any(axis):
            raise self.file.fault(f"axis of {what} is zero, expected a direction")
        unit = self.unit if kind in ("hinge", "ball") else 1.0
        damping, stiffness, rest, reference = (
            self.file.number(given.get(word), f"{word} of {what}", 0.0) for word in ("damping", "stiffness", "springref", "ref")
        )
        if stiffness and kind not in ("hinge", "slide"):
            self.file.refuse("stiffness", f"the stiffness of the {kind} {what}")
            stiffness = 0.0
        limits = self.file.numbers(given.get("range"), 2, f"range of {what}", [0.0, 0.0]) * unit
        if reference and kind in ("hinge", "slide"):
            self.start[identifier(name)] = reference * unit
        return Joint(
            name,
            kind,
            axis / np.linalg.norm(axis),
            self.file.numbers(given.get("pos"), 3, f"pos of {what}", np.zeros(3)),
            reference * unit,
            damping,
            stiffness,
            rest * unit,
            (float(limits[0]), float(limits[1])) if limits[0] < limits[1] else None,
        )

    def _mass(self, body: Element, childclass: str | None, name: str) -> Mass | None:
        rule = self.compiler.get("inertiafromgeom", "auto")
        inertial = body.find("inertial")
        if inertial is not None and rule != "true":
            return self._stated_mass(inertial, f"`inertial` of body `{name}`")
        masses = [] if rule == "false" else [self._mass_of_geom(geom, childclass, name) for geom in body.findall("geom")]
        heavy = [mass for mass in masses if mass is not None]
        return combined(heavy) if heavy else None

    def _stated_mass(self, inertial: Element, what: str) -> Mass | None:
        given = dict(inertial.attrib)
        mass = self.file.number(given.get("mass"), f"mass in {what}")
        position, turn = self._place(given, what)
        if "fullinertia" in given:
            xx, yy, zz, xy, xz, yz = self.file.numbers(given["fullinertia"], 6, f"fullinertia in {what}")
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        elif "diaginertia" in given:
            inertia = np.diag(self.file.numbers(given["diaginertia"], 3, f"diaginertia in {what}"))
        else:
            raise self.file.fault(f"{what} has neither `diaginertia` nor `fullinertia`; give one")
        if mass == 0 and not np.any(inertia):
            return None
        if not mass > 0:
            raise self.file.fault(f"mass in {what} is {mass:g}, expected a number above zero")
        return Mass(mass, position, turn @ inertia @ turn.T)

    def _geom(self, geom: Element, childclass: str | None, where: str) -> tuple[dict[str, str], str, str]:
        """Attributes and type of a geom, and what to call it."""
        what = f"geom `{geom.get('name')}` of {where}" if geom.get("name") else f"a geom of {where}"
        given = self.defaults.of(geom, childclass, what)
        return given, given.get("type", "mesh" if "mesh" in given else "sphere"), what

    def _mass_of_geom(self, geom: Element, childclass: str | None, body: str) -> Mass | None:
        given, kind, what = self._geom(geom, childclass, f"body `{body}`")
        # kg/m^3, of geoms that state neither mass nor density
        word = "mass" if "mass" in given else "density"
        number = self.file.number(given.get(word), f"{word} of {what}", 1000.0)
        if number < 0:
            raise self.file.fault(f"{word} of {what} is {number:g}, expected a number that is not negative")
        if number == 0:
            return None
        if kind not in SIZES:
            self.file.refuse(kind, f"the mass of {what}, of the type `{kind}`,", 'give body an `inertial`, or the geom mass="0"')
            return None
        position, turn, size = self._solid(given, kind, what)
        mass = number if word == "mass" else number * volume(kind, size)
        return Mass(mass, position, turn @ np.diag(mass * moments(kind, size)) @ turn.T)

    def _solid(self, given: dict[str, str], kind: str, what: str) -> tuple[Vector, Matrix, np.ndarray]:
        """Middle, axes and size of a geom."""
        position, turn = self._place(given, what)
        size = self.file.numbers(given.get("size"), None, f"size of {what}")
        if "fromto" in given and kind != "sphere":
            ends = self.file.numbers(given["fromto"], 6, f"fromto of {what}")
            along = ends[3:] - ends[:3]
            half = np.linalg.norm(along) / 2
            position, turn = (ends[:3] + ends[3:]) / 2, onto_axis(along)
            size = np.array([size[0], half] if kind in ("capsule", "cylinder") else [size[0], size[0], half])
        if len(size) < SIZES[kind] or np.any(size[: SIZES[kind]] <= 0):
            raise self.file.fault(f"size of {what} is `{given.get('size')}`, expected {SIZES[kind]} lengths above zero for the type `{kind}`")
        return position, turn, size[: SIZES[kind]]

    def _looks(self, holder: Element, childclass: str | None, where: str) -> tuple[Look, ...]:
        found = [self._look(geom, childclass, where) for geom in holder.findall("geom")]
        return tuple(look for look in found if look is not None)

    def _look(self, geom: Element, childclass: str | None, where: str) -> Look | None:
        given, kind, what = self._geom(geom, childclass, where)
        colour, opacity = colour_of(self.file.numbers(given["rgba"], 4, f"rgba of {what}")) if "rgba" in given else (None, 1.0)
        if opacity == 0:
            return None
        if kind in _LOOKS:
            position, turn, size = self._solid(given, kind, what)
            if kind == "box":
                size = 2 * size
            elif kind in ("capsule", "cylinder"):
                size = size * [1, 2]
            return Look(_LOOKS[kind], tuple(map(float, size)), position, turn, colour, opacity)
        if kind == "mesh" and given.get("mesh") in self.meshes:
            mesh = self.meshes[given["mesh"]]
            path = self.file.folder / self.compiler.get("meshdir", self.compiler.get("assetdir", "")) / (mesh.get("file") or "")
            if os.path.isfile(path):
                factors = self.file.numbers(mesh.get("scale"), 3, f"scale of the mesh of {what}", [1.0] * 3)
                return Look("mesh", tuple(factors), *self._place(given, what), colour, opacity, str(path))
        self.file.leave_out(f"geom of type {kind}")
        return None

    def _place(self, given: dict[str, str], what: str) -> tuple[Vector, Matrix]:
        """Position and rotation that attributes state. ValueError for several rotations, or numbers that say none."""
        position = self.file.numbers(given.get("pos"), 3, f"pos of {what}", np.zeros(3))
        stated = [word for word in ("quat", "axisangle", "euler", "xyaxes", "zaxis") if word in given]
        if not stated:
            return position, np.eye(3)
        if len(stated) > 1:
            raise self.file.fault(f"{what} is turned by {' and by '.join(f'`{word}`' for word in stated)}; expected one of them")
        (word,) = stated
        numbers = self.file.numbers(given[word], {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}[word], f"{word} of {what}")
        with np.errstate(invalid="ignore"):
            turn = self._turn(word, numbers)
        if not np.all(np.isfinite(turn)):
            raise self.file.fault(f"{word} of {what} is `{given[word]}`, which is no rotation")
        return position, turn

    def _turn(self, word: str, x: np.ndarray) -> Matrix:
        """The rotation that an attribute states by these numbers; NaN where they state none."""
        if word == "quat":
            return by_quaternion(x)
        if word == "axisangle":
            return about(x[:3] / np.linalg.norm(x[:3]), x[3] * self.unit)
        if word == "euler":
            return by_euler_angles(x * self.unit, self.sequence)
        if word == "zaxis":
            return onto_axis(x)
        along = x[:3] / np.linalg.norm(x[:3])
        across = x[3:] - (along @ x[3:]) * along
        across = across / np.linalg.norm(across)
        return np.stack([along, across, np.cross(along, across)], axis=1)

    def _motors(self, names: list[str]) -> Iterable[Motor]:
        for k, element in enumerate(self.file.root.findall("actuator/motor")):
            given = self.defaults.of(element, None, f"motor `{element.get('name') or k + 1}`")
            name = given.get("name") or f"{given.get('joint')}_motor"
            if given.get("joint") not in names:
                raise self.file.fault(f"motor `{name}` pushes `{given.get('joint')}`, which is no hinge or slide; {nearest(str(given.get('joint')), names)}")
            gear = self.file.numbers(given.get("gear"), None, f"gear of motor `{name}`", [1.0])[0]
            yield Motor(name, given["joint"], float(gear), self._limits(given, "ctrl", name), self._limits(given, "force", name))

    def _limits(self, given: dict[str, str], what: str, motor: str) -> tuple[float, float] | None:
        """The range of a motor's control or force, where it has one: stated, and not switched off."""
        low, high = self.file.numbers(given.get(f"{what}range"), 2, f"{what}range of motor `{motor}`", [0.0, 0.0])
        limited = given.get(f"{what}limited", "auto")
        inferred = self.compiler.get("autolimits", "true") == "true"
        if (limited == "true" and low >= high) or (limited == "auto" and not inferred and (low, high) != (0.0, 0.0)):
            raise self.file.fault(f'`{what}range` of motor `{motor}` and `{what}limited` contradict each other; state low < high and `{what}limited="true"`')
        return (float(low), float(high)) if limited == "true" or (limited == "auto" and low < high) else None
