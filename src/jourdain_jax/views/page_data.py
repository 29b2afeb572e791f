"""Data of the 3D page: a description in JSON, and an array of 32-bit floats to which it refers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from jourdain_jax.calculus.reals import largest
from jourdain_jax.calculus.rotations import matrices_to_quaternions
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.bodies import Visual
from jourdain_jax.views.looks import Drawn, DrawnBody, grounds_of, looks_of
from jourdain_jax.views.solids import radius_of, triangles_of


@dataclass(frozen=True)
class Display:
    """Display settings of `show`."""

    title: str
    follow: bool | None = None
    paths: Sequence | None = None
    forces: bool = True
    colours: Mapping[str, str] = field(default_factory=dict)
    view: Sequence = (22.0, -60.0)
    height: int = 480
    play: bool = False


@dataclass
class Numbers:
    """Buffer of 32-bit floats. Arrays in it are located by pairs (first index, count)."""

    parts: list[np.ndarray] = field(default_factory=list)
    count: int = 0

    def add(self, array) -> tuple[int, int]:
        """Append an array and return its location (first index, count)."""
        flat = np.asarray(array, np.float32).ravel()
        self.parts.append(flat)
        self.count += flat.size
        return self.count - flat.size, flat.size

    def bytes(self) -> bytes:
        """Return the buffer as little-endian bytes."""
        return np.concatenate(self.parts).astype("<f4").tobytes()


def page_data(motions: list[Trajectory], display: Display) -> tuple[dict, Numbers]:
    """Return the description of the page and its numbers."""
    drawn = [looks_of(motion, "show", 1000) for motion in motions]
    numbers, first = Numbers(), drawn[0]
    everywhere = np.concatenate(
        [body.extents().reshape(-1, 3) for one in drawn for body in one.bodies.values()]
    )
    near, far = (np.stack([x.min(axis=0), x.max(axis=0)]) for x in (_around_the_middle(drawn), everywhere))
    size, reach = (float(np.ptp(box, axis=0).max()) for box in (near, far))
    colours = {name: body.colour for one in drawn for name, body in one.bodies.items() if name}
    # by default, follow bodies that travel more than five times their size
    follow = (
        first.sized and reach > 5 * size and not _at_rest(first) if display.follow is None else display.follow
    )
    shown = size if follow else max(size, reach / 3)
    arrows, longest = _arrows(motions, drawn, shown) if display.forces else ([[] for _ in drawn], "")
    power = 10.0 ** np.floor(np.log10(shown / 4))
    tile = float(power * max(k for k in (1, 2, 5) if k * power <= shown / 4 * (1 + 1e-9)))
    grounds = grounds_of(motions[0], first, *far)
    squares = (
        f"squares of the ground: {tile:g} m" if any(ground["kind"] == "plane" for ground in grounds) else ""
    )
    page = {
        "title": display.title,
        "names": [
            {"name": name, "colour": display.colours.get(name, colour)} for name, colour in colours.items()
        ],
        "note": "; ".join(note for note in (squares, longest) if note),
        "span": [float(first.ts[0]), float(first.ts[-1])],
        "motions": [_motion(numbers, *one, display) for one in zip(motions, drawn, arrows, strict=True)],
        "grounds": [_ground(numbers, ground) for ground in grounds],
        "size": size,
        "reach": reach,
        "near": near.tolist(),
        "far": far.tolist(),
        "ground": 12 * reach + 60 * size,
        "tile": tile,
        "thickness": 0.018 * shown,
        "arrow": 0.3 * shown,  # length of a body's axes
        "follow": bool(follow),
        "view": np.asarray(display.view, float).tolist(),
        "play": bool(display.play),
    }
    return page, numbers


def _motion(numbers: Numbers, motion: Trajectory, drawn: Drawn, arrows: list, display: Display) -> dict:
    colour = {name: display.colours.get(name, body.colour) for name, body in drawn.bodies.items()}
    if display.paths is not None:
        paths = [
            (name, np.asarray(motion.point(name, local))[drawn.reached]) for name, local in display.paths
        ]
    elif drawn.contacts:
        paths = [(contact.body, np.asarray(contact.point)) for contact in drawn.contacts.values()]
    else:
        paths = [(name, body.positions) for name, body in drawn.bodies.items() if _moves(body)]
    return {
        "ts": numbers.add(drawn.ts),
        "bodies": [_body(numbers, body, drawn, colour[name]) for name, body in drawn.bodies.items()],
        "paths": [{"colour": colour[name], "points": numbers.add(points)} for name, points in paths],
        "forces": [
            {"name": name, "points": numbers.add(points), "vectors": numbers.add(vectors)}
            for name, points, vectors in arrows
        ],
    }


def _body(numbers: Numbers, body: DrawnBody, drawn: Drawn, colour: str) -> dict:
    quaternions = quaternions_of(body.orientations)
    return {
        "name": body.name,
        "moves": bool(body.name) and _moves(body),
        "p": numbers.add(_still(body.positions)),
        "q": numbers.add(_still(quaternions)),
        "turns": numbers.add(_whole_turns(quaternions, body.angular_velocities, drawn.ts)),
        "shapes": [_shape(numbers, look, colour, drawn.thin) for look in body.looks],
    }


def _shape(numbers: Numbers, visual: Visual, colour: str, thin: float) -> dict:
    shape: dict = {"kind": visual.kind, "colour": visual.colour or colour, "opacity": visual.opacity}
    size = np.asarray(visual.size)
    if visual.kind == "line":
        return shape | {
            "size": [],
            "count": size.shape[1],
            "points": numbers.add(_still(size)),
            "radius": radius_of(visual) or thin,
        }
    if visual.kind == "mesh":
        shape["mesh"] = numbers.add(size[0] * triangles_of(visual)[:, :3])
    places, turns = np.asarray(visual.position), quaternions_of(np.asarray(visual.orientation))
    return shape | {
        "p": numbers.add(_still(places)),
        "q": numbers.add(_still(turns)),
        "turns": [0],
        "size": size[0].ravel().tolist(),
    }


def _ground(numbers: Numbers, ground: dict) -> dict:
    if ground["kind"] == "plane":
        return {
            "kind": "plane",
            "p": ground["origin"].tolist(),
            "q": quaternions_of(ground["axes"][None])[0].tolist(),
        }
    return {"kind": "mesh", "size": [], "mesh": numbers.add(ground["triangles"])}


def quaternions_of(rotations: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (times, 3, 3) to quaternions (times, 4) in the order x y z w, with signs that
    make them continuous in time.
    """
    found = matrices_to_quaternions(rotations)[:, [1, 2, 3, 0]]
    signs = np.sign(np.sum(found[1:] * found[:-1], axis=1))
    found[1:] *= np.cumprod(np.where(signs == 0, 1, signs))[:, None]
    return found


def _whole_turns(quaternions: np.ndarray, velocities: np.ndarray, ts: np.ndarray) -> np.ndarray:
    """Return the number of whole turns of a body between saved times, as of fast wheels, in addition to the
    shortest rotation.
    """
    if len(ts) < 2:
        return np.zeros(1)
    a, b = quaternions[:-1], quaternions[1:]
    # the vector part of b a*, half the shortest turn
    vector = a[:, 3:] * b[:, :3] - b[:, 3:] * a[:, :3] - np.cross(b[:, :3], a[:, :3])
    sine = np.linalg.norm(vector, axis=1)
    angle = 2 * np.arctan2(sine, np.sum(a * b, axis=1))
    axis = vector / np.maximum(sine, 1e-300)[:, None]
    turned = np.sum((velocities[:-1] + velocities[1:]) / 2 * axis, axis=1) * np.diff(ts)
    whole = np.where(sine > 1e-9, np.round((turned - angle) / (2 * np.pi)), 0.0)
    return whole if np.any(whole) else np.zeros(1)


def _still(values: np.ndarray) -> np.ndarray:
    """Return the values at all times, or only the first value if they are constant."""
    return values[:1] if np.ptp(values, axis=0).max(initial=0.0) < 1e-12 * (1 + largest(values)) else values


def _at_rest(drawn: Drawn) -> bool:
    """Return whether the scene has visuals that are fixed in the inertial frame, such as a table."""
    return "" in drawn.bodies and any(
        len(_still(np.asarray(look.position))) == 1 and look.kind != "line" for look in drawn.bodies[""].looks
    )


def _moves(body: DrawnBody) -> bool:
    return len(_still(body.positions)) > 1


def _around_the_middle(drawn: list[Drawn]) -> np.ndarray:
    """Return points (points, 3), m, relative to the centre of the bodies at each time. Their bounding box
    contains the bodies at every time.
    """
    points = []
    for one in drawn:
        moving = [body for name, body in one.bodies.items() if name and _moves(body)]
        middle = (
            np.mean([body.positions for body in moving], axis=0) if moving else np.zeros((len(one.ts), 3))
        )
        points += [
            (body.extents() - middle[:, None]).reshape(-1, 3) for body in moving or one.bodies.values()
        ]
    return np.concatenate(points)


def _arrows(motions: list[Trajectory], drawn: list[Drawn], size: float) -> tuple[list, str]:
    """Return (name, point, scaled force) of every contact of each motion, and a note with the force of the
    longest arrow.

    If a few forces are far larger than the others (a fall, a nearly singular configuration), their arrows are
    truncated so that the others remain visible.
    """
    found = []
    for motion, one in zip(motions, drawn, strict=True):
        own = []
        for name, force in (motion.contact_forces() if one.contacts else {}).items():
            contact = one.contacts[name]
            normal = np.asarray(force.normal)[one.reached]
            tangential = np.asarray(force.tangential)[one.reached]
            vectors = normal[:, None] * np.asarray(contact.plane.normal) + np.einsum(
                "tk,tkj->tj", tangential, np.asarray(contact.plane.tangents)
            )
            own.append((name, np.asarray(contact.point), np.where(np.isfinite(vectors), vectors, 0.0)))
        found.append(own)
    sizes = np.concatenate(
        [np.zeros(1), *(np.linalg.norm(vectors, axis=1) for own in found for _, _, vectors in own)]
    )
    strongest = float(sizes.max())
    usual = 2.0 * float(np.quantile(sizes[1:], 0.9)) if strongest else 0.0
    longest = usual if 0.0 < 2.0 * usual <= strongest else strongest
    if strongest:
        told = f"longest arrow: {longest:.3g} N" + (
            f" and more, up to {strongest:.3g} N" if longest < strongest else ""
        )
    else:
        told = ""

    def scaled(vectors: np.ndarray) -> np.ndarray:
        return (
            0.4 * size * vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), longest or 1.0)
        )

    return [[(name, points, scaled(vectors)) for name, points, vectors in own] for own in found], told
