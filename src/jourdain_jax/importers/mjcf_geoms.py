"""Geoms of MJCF files: their places, sizes, masses and shapes for drawing.

It also has constant rotation matrices from angles, quaternions and axes, combined masses, and volumes and
moments of inertia of uniform solids. Sizes are those of MJCF: radii and half lengths.
"""

import math
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jourdain_jax.calculus.rotations import onto_axis
from jourdain_jax.importers.mjcf_elements import Defaults, all_of
from jourdain_jax.importers.tree import Look, Mass, Matrix, Vector
from jourdain_jax.importers.xml_file import Element, Part, XmlFile


def about(axis: Vector, angle: float) -> Matrix:
    """Return the rotation by `angle` (rad) about a unit vector."""
    return Rotation.from_rotvec(angle * axis).as_matrix()


def by_euler_angles(angles: Vector, sequence: str) -> Matrix:
    """Return the rotation of MJCF's `euler`, about successive axes (rad). Lower-case letters are axes of the
    rotated frame, upper-case letters axes of the fixed frame.
    """
    turn = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        one = Rotation.from_euler(letter.lower(), angle).as_matrix()
        turn = turn @ one if letter.islower() else one @ turn
    return turn


def by_quaternion(q: Float[np.ndarray, "4"]) -> Matrix:
    """Return the rotation of a quaternion (w, x, y, z) of any norm; NaN for the zero quaternion."""
    return Rotation.from_quat(np.roll(q, -1)).as_matrix() if np.any(q) else np.full((3, 3), np.nan)


def combined(masses: list[Mass]) -> Mass:
    """Return the combined mass properties of several masses in one frame, by the parallel-axis theorem:

    `I = sum I_i + m_i (d_i.d_i - d_i d_i')`.
    """
    total = sum(one.mass for one in masses)
    centre = sum(one.mass * one.centre for one in masses) / total if total else masses[0].centre
    inertia = np.zeros((3, 3))
    for one in masses:
        d = one.centre - centre
        inertia += one.inertia + one.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Mass(total, centre, inertia)


SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}  # count of numbers in a size


def volume(kind: str, size: Float[np.ndarray, "_"]) -> float:
    """Return the volume of a solid, m^3."""
    if kind in ("sphere", "ellipsoid"):
        return 4 / 3 * math.pi * math.prod(np.broadcast_to(size, 3))
    if kind == "box":
        return 8 * math.prod(size)
    cylinder = 2 * math.pi * size[0] ** 2 * size[1]
    return cylinder + volume("sphere", size[:1]) if kind == "capsule" else cylinder


def moments(kind: str, size: Float[np.ndarray, "_"]) -> Float[np.ndarray, "3"]:
    """Return principal moments of inertia about the centre of a solid of 1 kg. The axis of cylinders and
    capsules is z.
    """
    if kind in ("sphere", "ellipsoid", "box"):
        squares = np.square(np.broadcast_to(size, 3))
        return (np.sum(squares) - squares) / (3 if kind == "box" else 5)
    radius, half = size
    straight = np.array([(3 * radius**2 + 4 * half**2) / 12] * 2 + [radius**2 / 2])
    if kind == "cylinder":
        return straight
    # two half balls, with mass centres 3 r/8 from their flat sides: 2 r^2/5 + h^2 + 3 h r/4
    ends = np.array([0.4 * radius**2 + half**2 + 0.75 * half * radius] * 2 + [0.4 * radius**2])
    share = volume("cylinder", size) / volume("capsule", size)
    return share * straight + (1 - share) * ends


Place = tuple[Vector, Matrix]  # position and rotation
Geom = tuple[Part, str, Place]  # attributes, type, and frame relative to the body
HERE = np.zeros(3), np.eye(3)
_TURNS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}  # attribute -> count of numbers
# type -> shape for drawing, and factors of the sizes
_LOOKS: dict = {"sphere": ("ball", 1), "ellipsoid": ("ellipsoid", 1), "box": ("box", 2)}
_LOOKS |= {kind: (kind, [1, 2]) for kind in ("capsule", "cylinder")}


class GeomReader:
    """Reader of the places and geoms of one file."""

    def __init__(self, file: XmlFile):
        self.file, self.defaults, compiler = file, Defaults(file), all_of(file, "compiler")
        self.settings = {
            "angle": "degree",
            "eulerseq": "xyz",
            "inertiafromgeom": "auto",
            "autolimits": "true",
        } | dict(compiler.given)
        self.unit = 1.0 if self.settings["angle"] == "radian" else math.pi / 180
        if len(self.settings["eulerseq"]) != 3 or set(self.settings["eulerseq"].lower()) - set("xyz"):
            raise compiler.fault(
                "`eulerseq`",
                f"`{self.settings['eulerseq']}`, expected three letters, each one of x, y, z, X, Y, Z",
            )
        self.meshes = {
            mesh.get("name") or Path(mesh.get("file", "")).stem: mesh
            for mesh in file.root.findall("asset/mesh")
        }

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
                inner = within(frame, self._place(Part(self.file, f"frame `{child.get('name')}`", child)))
                yield from self._held(child, kind, child.get("childclass") or childclass, inner)

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
        return *within(frame, (position, turn)), size[: SIZES[kind]]

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
                    *within(frame, self._place(given)),
                    colour,
                    opacity,
                    str(path),
                )
        self.file.leave_out(f"geom of type {kind}")
        return None

    def _place(self, given: Part) -> Place:
        """Return position and rotation from attributes. Raises ValueError for several rotations, and for
        numbers that define no rotation.
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
        """Return the rotation that the numbers `x` of an attribute define; NaN if they define none."""
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


def within(frame: Place, inner: Place) -> Place:
    """Convert a place in a frame to a place in the parent of that frame."""
    return frame[0] + frame[1] @ inner[0], frame[1] @ inner[1]
