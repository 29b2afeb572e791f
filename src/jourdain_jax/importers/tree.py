"""Links and joints of robot files: a tree of frames. Each has a place in its parent frame and is moved by its
joints.

All values are plain numbers in SI units and radians. Rotation matrices convert components from the link's
frame to the parent's.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Joint:
    """The motion of a link relative to its place. The joint of a moving base has the `name` ""."""

    name: str
    kind: str  # "hinge", "slide", "ball", "free" or "planar"
    # unit vector along the axis, or along the normal of a planar joint
    axis: Vector = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    # m, the fixed point of the link for a hinge or ball
    anchor: Vector = field(default_factory=lambda: np.zeros(3))
    reference: float = 0.0  # the coordinate at the link's place in the file
    damping: float = 0.0  # N s/m or N m s
    stiffness: float = 0.0  # N/m or N m
    rest: float = 0.0  # the coordinate of the unloaded spring
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Mass:
    """The mass properties of a link."""

    mass: float  # kg
    centre: Vector  # m, mass centre in the link's frame
    inertia: Matrix  # kg m^2, about the mass centre, axes of the link


@dataclass(frozen=True)
class Look:
    """A shape of a link, for pictures."""

    kind: str  # "ball", "box", "cylinder", "capsule", "ellipsoid" or "mesh"
    size: tuple[float, ...]  # m, as for `jj.Visual`; scale factors for a mesh
    position: Vector  # m, in the link's frame
    turn: Matrix
    colour: str | None = None
    opacity: float = 1.0
    path: str | None = None  # of the mesh file


@dataclass(frozen=True)
class Link:
    """A link. Its joints act in sequence; without joints it is fixed to its parent."""

    name: str
    parent: str | None  # None: the inertial frame
    position: Vector  # m, of its frame in the parent's frame
    turn: Matrix
    joints: tuple[Joint, ...] = ()
    mass: Mass | None = None
    looks: tuple[Look, ...] = ()


@dataclass(frozen=True)
class Follower:
    """A joint whose coordinate q is a polynomial of the coordinate of another joint, or constant:
    `q - reference = sum of c_k (q_leader - its reference)^k`.
    """

    joint: str
    leader: str  # "" if q is constant
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class Closure:
    """A point of a link that coincides with a point of another link, as in the pose of the file. With `turn`,
    the links do not rotate relative to each other either.
    """

    name: str
    link: str | None  # None: the inertial frame
    other: str | None
    anchor: Vector  # m, in the frame of the link
    turn: bool


@dataclass(frozen=True)
class Push:
    """A force at a point of a link and a torque on the link, both in its frame."""

    link: str
    point: Vector  # m
    force: Vector  # N
    torque: Vector  # N m


@dataclass(frozen=True)
class Motor:
    """An input that drives a hinge or slide with `gear` times its value, or pushes a link. Limits apply first
    to the input, then to the force.
    """

    name: str
    joint: str  # "" if it drives none
    gear: float = 1.0
    control: tuple[float, float] | None = None
    force: tuple[float, float] | None = None  # before the gear
    push: Push | None = None  # force and torque for an input of 1, in place of a joint


@dataclass(frozen=True)
class Tree:
    """A mechanism. Links are ordered, parents before their children."""

    name: str
    links: tuple[Link, ...]
    gravity: Vector  # m/s^2
    motors: tuple[Motor, ...] = ()
    ties: tuple[Follower | Closure, ...] = ()  # geometric constraints
    free: tuple[str, ...] = ()  # links whose positions are parameters
    start: dict[str, float] = field(default_factory=dict)  # coordinate -> value stated in the file

    def moving(self) -> set[str]:
        """Return names of the links that any joint moves."""
        found: set[str] = set()
        for link in self.links:
            if link.joints or link.parent in found:
                found.add(link.name)
        return found
