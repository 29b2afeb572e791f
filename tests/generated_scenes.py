"""Scenes put together from parts by a seeded generator: bodies, rows, loads, drives, redundancies and
quasi-velocities, mixed as no textbook mixes them.

`recipe(seed)` is the structure (static), `generated(recipe, seed)` a scene of it with random parameters:
assembled at its reference configuration, the middle of its domain, whatever the parameters are.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj

GROUND = -1
MOST_SPEEDS = 6


@dataclass(frozen=True)
class Part:
    """A row or load: its kind, and the numbers of the bodies (`GROUND`), coordinates or rows that it is
    about.
    """

    kind: str
    on: tuple[int, ...] = ()


@dataclass(frozen=True)
class Recipe:
    """The structure of a scene."""

    seed: int
    bodies: tuple[str, ...]
    rows: tuple[Part, ...]
    loads: tuple[Part, ...]
    own_speeds: str  # "", "homogeneous" or "affine" quasi-velocities

    def __str__(self):
        rows = ", ".join(f"{p.kind}{list(p.on)}" for p in self.rows)
        loads = ", ".join(f"{p.kind}{list(p.on)}" for p in self.loads)
        own = self.own_speeds or "none"
        return (
            f"structure {self.seed}: bodies {', '.join(self.bodies)}; rows {rows or 'none'}; loads"
            f" {loads or 'none'}; own speeds: {own}"
        )

    def kinds(self):
        """Everything that occurs in it."""
        own = {f"{self.own_speeds} quasi-velocities"} if self.own_speeds else set()
        return {*self.bodies, *(p.kind for p in self.rows), *(p.kind for p in self.loads)} | own

    @property
    def scleronomic(self):
        """Whether nothing depends on time, and bodies rest when the speeds vanish."""
        return self.kinds().isdisjoint(TIMED | MOVING)

    @property
    def reversible(self):
        """Whether motions can run backwards: nothing depends on time, and no force is odd in speeds."""
        return self.scleronomic and self.kinds().isdisjoint(ODD)


# Coordinates by kind of body: stems, the middle of their domain, and whether each is a length. "*" stands for
# a quaternion.
FLAT, SPACE, TURNED = (
    (("x", 0.0), ("y", 0.0)),
    (("x", 0.0), ("y", 0.0), ("z", 0.6)),
    (("yaw", 0.4), ("lean", 0.3), ("spin", 0.2)),
)
KINDS = {
    "particle": SPACE,
    "bead": FLAT,
    "plate": (*FLAT, ("yaw", 0.4)),
    "block": (*SPACE, *TURNED),
    "top": (*SPACE, ("*", 0.0)),
    "disc": (*FLAT, *TURNED),
    "wheel": (*SPACE, *TURNED),
    "ball": (*FLAT, ("*", 0.0)),
    "ball on a turntable": (*FLAT, ("*", 0.0)),
    "ball on a belt": (*FLAT, ("*", 0.0)),
    "ball on a lift": (*SPACE, ("*", 0.0)),
    "arm": (("turn", 0.5),),
    "slider": (("x", 0.5),),
    "swing": (("turn", 0.5),),
}
RIGID = {"plate", "block", "top", "disc", "wheel", "arm"}
TIMED = {"ball on a lift", "swing", "timed row", "driven", "gust", "tide"}
MOVING = {
    "ball on a turntable",
    "ball on a belt",
    "affine row",
    "affine quasi-velocities",
    "constant speed",
    "input",
}
ODD = {"damper", "drag", "magnet", "steering"}
GEOMETRIC = {"rod", "pin", "flat pin", "curve"}
LENGTHS = {"x", "y", "z"}


def coordinates_of(kind):
    """Stems and middles of the coordinates of a body of this kind; methods of scenes may not read the
    dictionary itself.
    """
    return KINDS[kind]


def coordinate_list(recipe):
    """Body, stem and middle of every coordinate; a quaternion counts once."""
    return [
        (i, stem, middle + (1.1 * i if stem == "x" else 0.0))
        for i, kind in enumerate(recipe.bodies)
        for stem, middle in KINDS[kind]
    ]


def speed_count(kind):
    """Number of speeds of a kind of body."""
    return sum(3 if stem == "*" else 1 for stem, _ in KINDS[kind])


def plain_coordinates(recipe):
    """Positions, among all speeds, of coordinates that are no quaternions."""
    found, at = [], 0
    for _, stem, _ in coordinate_list(recipe):
        found += [] if stem == "*" else [at]
        at += 3 if stem == "*" else 1
    return found


def body_name(i):
    """Names out of order, so that the engine's own order differs from that of the recipe."""
    return f"{'khbsc'[i]}{i}"


class Generated(jj.Scene):
    """A scene made from a recipe."""

    recipe: Recipe = eqx.field(static=True)
    masses: object = jj.parameter(unit="kg", positive=True)  # per body
    sides: object = jj.parameter(unit="m", positive=True)  # per body, three each: as of a cuboid
    sizes: object = jj.parameter(unit="m", positive=True)  # per body: radius of a wheel, length of an arm
    strengths: object = jj.parameter()  # per load
    factors: object = jj.parameter()  # per row
    anchors: object = jj.parameter()  # per row, three each: where it holds
    gravity: object = jj.parameter(unit="m/s^2")

    @property
    def coordinates(self):
        return jj.coordinates(
            *(
                jj.quaternion(f"q{i}") if stem == "*" else f"{stem}{i}"
                for i, stem, _ in coordinate_list(self.recipe)
            )
        )

    @property
    def inputs(self):
        return jj.inputs("push") if any(p.kind == "input" for p in self.recipe.loads) else jj.inputs("")

    @property
    def domain(self):
        return {
            f"{stem}{i}": (middle - 0.5, middle + 0.5)
            for i, stem, middle in coordinate_list(self.recipe)
            if stem != "*"
        }

    def reference(self):
        """The configuration at which it is assembled."""
        q: list[float] = []
        for _, stem, middle in coordinate_list(self.recipe):
            q += [0.9, 0.1, -0.2, np.sqrt(1 - 0.86)] if stem == "*" else [middle]
        return np.array(q)

    def bodies(self, t, q):
        made: list = []
        for i, kind in enumerate(self.recipe.bodies):
            made.append(self._body(i, kind, t, q, made[-1] if made else None))
        return {body_name(i): body for i, body in enumerate(made)}

    def _body(self, i, kind, t, q, parent):
        m, size, o = self.masses[i], self.sizes[i], 0.0 * t
        value = {stem: q[f"{stem}{i}"] for stem, _ in coordinates_of(kind) if stem != "*"}
        if kind == "swing":
            pivot = jnp.stack([0.3 * jnp.sin(2.0 * t), o, o])
            return jj.Particle(
                m, pivot + size * jnp.stack([jnp.sin(value["turn"]), o, -jnp.cos(value["turn"])])
            )
        if kind in ("arm", "slider"):
            at = jnp.zeros(3) if parent is None else parent.position
            frame = parent.orientation if isinstance(parent, jj.RigidBody) else jnp.eye(3)
            if kind == "slider":
                return jj.Particle(m, at + frame @ jnp.stack([value["x"], o, o + 0.2 * size]))
            frame = frame @ (jj.rot_y, jj.rot_x, jj.rot_z)[i](value["turn"])
            return jj.RigidBody(
                m, self._moments(i), at + frame @ jnp.stack([size, 0.2 * size, -0.5 * size]), frame
            )
        position = jnp.stack([value["x"], value["y"], value.get("z", o)])
        if kind in ("particle", "bead"):
            return jj.Particle(m, position)
        if kind == "plate":
            return jj.RigidBody(m, self._moments(i), position, jj.rot_z(value["yaw"]))
        if ("*", 0.0) in coordinates_of(kind):
            frame = jj.quaternion_to_matrix(q[f"q{i}"])
            if kind == "top":
                return jj.RigidBody(m, self._moments(i), position, frame)
            return jj.RigidBody.ball(
                m,
                size,
                position=position if "z" in value else position + jnp.stack([o, o, size]),
                orientation=frame,
            )
        frame = jj.rot_z(value["yaw"]) @ jj.rot_x(value["lean"])
        whole = frame @ jj.rot_y(value["spin"])
        if kind == "block":
            return jj.RigidBody(m, self._moments(i), position, whole)
        centre = position if kind == "wheel" else position + frame @ jnp.stack([o, o, size])
        return jj.RigidBody.thin_disc(m, size, axis="y", position=centre, orientation=whole)

    def _moments(self, i):
        squares = self.masses[i] * self.sides[i] ** 2 / 12
        products = 0.05 * (jnp.ones((3, 3)) - jnp.eye(3)) * jnp.min(squares)
        return jnp.diag(jnp.sum(squares) - squares) + products

    def contacts(self, pose):
        made, o = {}, 0.0 * pose.t
        for i, kind in enumerate(self.recipe.bodies):
            name, size = body_name(i), self.sizes[i]
            if kind in ("disc", "wheel"):
                made[f"rim {i}"] = jj.disc_contact(
                    pose[name], size, height="row" if kind == "wheel" else "coordinates"
                )
            elif kind == "ball on a lift":
                lift = jj.Plane(
                    jnp.stack([o, o, 0.2 * jnp.sin(pose.t)]),
                    velocity=jnp.stack([o + 0.1, o, 0.2 * jnp.cos(pose.t)]),
                )
                made[f"lift {i}"] = jj.ball_contact(pose[name], size, ground=lift, height="row")
            elif kind.startswith("ball"):
                plane = {
                    "ball on a turntable": jj.Plane(angular_velocity=(0.0, 0.0, 0.7)),
                    "ball on a belt": jj.Plane(velocity=(0.3, -0.2, 0.0)),
                }.get(kind)
                made[f"ground {i}"] = jj.ball_contact(pose[name], size, ground=plane)
        return made

    def place(self, pose, i, local):
        """A point of body i, or of the ground."""
        return local if i == GROUND else pose[body_name(i)].place(local)

    def _geometric(self, s, pose):
        """Value of geometric row s; None where the row is of another kind."""
        part, hold, factor = self.recipe.rows[s], self.anchors[s], self.factors[s]
        if part.kind in ("rod", "pin", "flat pin"):
            own = pose[body_name(part.on[0])].place(jnp.stack([0.3, 0.1, -0.2]) * self.sizes[part.on[0]])
            if part.kind == "rod":
                return jj.rod(own, self.place(pose, part.on[1], jnp.stack([0.1, -0.2, 0.1])), hold[0])
            return jj.pin(own, self.place(pose, part.on[1], hold), axes="xyz" if part.kind == "pin" else "xy")
        if part.kind == "curve":
            r = pose[body_name(part.on[0])].position
            return r[1] - factor * jnp.sin(r[0]) - hold[0]
        if part.kind in ("copy", "sum"):
            values = [self._geometric(k, pose) for k in part.on]
            return None if values[0] is None else factor * sum(jnp.sum(value) for value in values)
        return None

    def geometric_constraints(self, pose):
        values = {f"{part.kind} {s}": self._geometric(s, pose) for s, part in enumerate(self.recipe.rows)}
        return {name: value for name, value in values.items() if value is not None}

    def _velocity(self, s, motion):
        """Value of velocity row s; None where the row is of another kind."""
        part, factor, t = self.recipe.rows[s], self.factors[s], motion.t
        if part.kind == "edge":
            body = motion[body_name(part.on[0])]
            return jj.knife_edge(body, body.place([0.4, 0.0, 0.1]), body.orientation[:, 1])
        if part.kind == "constant speed":
            v = motion[body_name(part.on[0])].velocity
            return v @ v - 0.6
        if part.kind in ("copy", "sum"):
            values = [self._velocity(k, motion) for k in part.on]
            return None if values[0] is None else factor * sum(values)
        if part.kind not in ("steered row", "affine row", "timed row"):
            return None
        w, q = self.rates(motion), motion.q.array
        k, m = part.on
        if part.kind == "steered row":
            return w[k] - factor * jnp.sin(q[0] + q[-1]) * w[m]
        if part.kind == "affine row":
            return w[k] - factor * jnp.cos(q[0]) * w[m] - 0.3 * q[-1] - 0.1
        return w[k] - factor * jnp.sin(2.0 * t) * w[m] - 0.4 * jnp.cos(t) * q[0]

    def rates(self, motion):
        """The rates that belong to the coordinates: quaternions by body angular velocity."""
        return motion.u.array

    def velocity_constraints(self, motion):
        values = {f"{part.kind} {s}": self._velocity(s, motion) for s, part in enumerate(self.recipe.rows)}
        return {name: value for name, value in values.items() if value is not None}

    def prescribed(self, t):
        names, middles = self.coordinate_names.entries, self.reference()
        return {
            names[p.on[0]]: middles[p.on[0]] + 0.3 * jnp.sin(1.5 * t)
            for p in self.recipe.rows
            if p.kind == "driven"
        }

    def loads(self, motion):
        made = []
        for k, part in enumerate(self.recipe.loads):
            load = self._load(part, self.strengths[k], motion)
            made += [] if load is None else [load]
        return tuple(made)

    def _load(self, part, strength, motion):
        t, u = motion.t, motion.u.array
        if part.kind in ("drag", "input"):
            speed, w = self.speed_names.entries[part.on[0]], u[part.on[0]]
            if part.kind == "drag":
                return jj.generalized_force(motion, **{speed: -strength * w * (1 + w * w)})
            return jj.generalized_force(
                motion, **{speed: strength * motion.inputs.push * jnp.cos(motion.q.array[0])}
            )
        bodies = [None if i == GROUND else motion[body_name(i)] for i in part.on]
        ends = [
            jj.fixed_point((0.2, -0.9, 1.4)) if body is None else body.point((0.1, 0.2, 0.1))
            for body in bodies[:2]
        ]
        if part.kind == "weight":
            return jj.gravity(motion, self.gravity, np.array((0.1, -0.6, -0.7)) / 0.86**0.5)
        if part.kind == "spring":
            return jj.spring(*ends, strength, 0.3)
        if part.kind == "damper":
            return jj.damper(*ends, strength)
        if part.kind == "torque":
            return jj.torque(motion, body_name(part.on[0]), strength * bodies[0].orientation[:, 2])
        if part.kind == "steering":
            return jj.torque(motion, body_name(part.on[0]), -strength * bodies[0].angular_velocity)
        if part.kind == "follower":
            return jj.point_force(bodies[0].point((0.2, 0.0, 0.1)), strength * bodies[0].orientation[:, 0])
        if part.kind == "magnet":
            return jj.point_force(
                bodies[0].point(), strength * jnp.cross(bodies[0].velocity, jnp.array([0.2, -0.4, 1.0]))
            )
        if part.kind == "gust":
            return jj.point_force(
                bodies[0].point(), strength * jnp.stack([jnp.sin(3.0 * t), 0.5 + 0.0 * t, jnp.cos(t)])
            )
        return None  # potentials of the scene itself

    def potential(self, pose):
        V, q = None, pose.q.array
        for k, part in enumerate(self.recipe.loads):
            if part.kind in ("well", "tide"):
                grows = jnp.cos(2.0 * pose.t) if part.kind == "tide" else 1.0
                more = (
                    self.strengths[k] * grows * (0.5 * q[0] ** 2 + 0.25 * q[-1] ** 4 + q[0] * jnp.sin(q[-1]))
                )
                V = more if V is None else V + more
        return V


class GeneratedWithOwnSpeeds(Generated):
    """A generated scene with quasi-velocities: rates `w = W(q) u (+ w_0(t, q))`, W unit lower triangular."""

    @property
    def speeds(self):
        return jj.speeds(" ".join(f"u{k}" for k in range(len(self.coordinates.default_speeds))))

    def coordinate_rates(self, t, q, u):
        return self.coordinates.default_rates(q.array, self._rates(q.array, u.array))

    def _rates(self, q, u):
        rates = [u[0]]
        for k in range(1, u.shape[0]):
            rates.append(u[k] + (0.5 * jnp.sin(q[0] + 0.3 * k) - 0.2) * u[k - 1])
        w = jnp.stack(rates)
        return w + 0.2 * jnp.cos(q[-1]) if self.recipe.own_speeds == "affine" else w

    def rates(self, motion):
        return self._rates(motion.q.array, motion.u.array)


def recipe(seed):
    """The structure with this number: first body and first row go through all kinds in turn, the rest is
    drawn.
    """
    draw = np.random.default_rng(1000 + seed)
    names = list(KINDS)
    bodies = [names[seed % len(names)]]
    while len(bodies) < 3 and draw.uniform() < (0.6 if len(bodies) == 1 else 0.35):
        more = str(draw.choice(["particle", "bead", "plate", "arm", "slider", "block", "disc", "ball"]))
        bodies += [more] if sum(speed_count(kind) for kind in (*bodies, more)) <= MOST_SPEEDS else []
    empty = Recipe(seed, tuple(bodies), (), (), ["", "", "homogeneous", "", "affine"][seed % 5])
    rows = _drawn_rows(empty, draw)
    return replace(empty, rows=rows, loads=_drawn_loads(empty, draw))


def _drawn_rows(made, draw):
    bodies, free = made.bodies, plain_coordinates(made)
    held = {"disc": 2, "wheel": 3, "ball on a lift": 3}
    left = sum(speed_count(kind) - held.get(kind, 2 * kind.startswith("ball")) for kind in bodies)
    held_down = [kind in ("disc", "wheel") or kind.startswith("ball") for kind in bodies]
    kinds = [
        "edge",
        "rod",
        "flat pin",
        "pin",
        "steered row",
        "curve",
        "affine row",
        "timed row",
        "driven",
        "constant speed",
        "rod",
        "edge",
    ]
    wanted = [kinds[(7 * made.seed + 4 + k) % len(kinds)] for k in range(len(kinds))][
        : 1 + int(draw.integers(0, 3))
    ]
    rows: list[Part] = []
    for kind in wanted:
        part, count = None, 1
        loose = [
            i for i, body in enumerate(bodies) if body not in ("arm", "slider", "swing") and not held_down[i]
        ]
        if kind == "edge":
            on = [i for i in loose if bodies[i] in RIGID]
            part = Part(kind, (on[0],)) if on else None
        elif kind in GEOMETRIC:
            tied = {
                part.on[0] for part in rows if part.kind in GEOMETRIC
            }  # a second such row on one body may contradict the first
            on = [
                i
                for i in loose
                if i not in tied and (kind != "pin" or bodies[i] in ("particle", "block", "top"))
            ]
            if on:
                other = [j for j in range(len(bodies)) if j < on[-1]]
                part = (
                    Part(kind, (on[-1], int(draw.choice([GROUND, *other]))))
                    if kind != "curve"
                    else Part(kind, (on[-1],))
                )
            count = {"pin": 3, "flat pin": 2}.get(kind, 1)
        elif kind == "driven":
            first = [
                i for i, (body, stem, _) in enumerate(coordinate_list(made)) if body in loose and stem == "x"
            ]
            part = Part(kind, (_coordinate_index(made, first[0]),)) if first else None
        elif kind == "constant speed":
            part = Part(kind, (loose[0],)) if loose and bodies[loose[0]] in ("particle", "bead") else None
        elif len(free) > 1:
            k, m = draw.choice(len(free), 2, replace=False)
            part = Part(kind, (free[int(k)], free[int(m)]))
        if part is not None and left - count >= 1:
            rows.append(part)
            left -= count
    geometric = [s for s, part in enumerate(rows) if part.kind in GEOMETRIC]
    alike = [
        group
        for group in (geometric, [s for s, p in enumerate(rows) if s not in geometric and p.kind != "driven"])
        if group
    ]
    if alike and made.seed % 3 != 1:
        group = alike[int(draw.integers(len(alike)))]
        rows.append(Part("copy", (group[0],)) if len(group) == 1 else Part("sum", tuple(group[:2])))
    return tuple(rows)


def _coordinate_index(made, number):
    """Position among the entries of q of a coordinate given by its place in the list."""
    return sum(4 if stem == "*" else 1 for _, stem, _ in coordinate_list(made)[:number])


def _drawn_loads(made, draw):
    rigid = [i for i, kind in enumerate(made.bodies) if kind not in ("particle", "bead", "slider", "swing")]
    first, last = 0, len(made.bodies) - 1
    free = plain_coordinates(made)
    choices = {
        "weight": (),
        "spring": (last, GROUND if last == 0 else first),
        "well": (),
        "torque": (rigid[0],) if rigid else None,
        "follower": (rigid[-1],) if rigid else None,
        "damper": (first, GROUND),
        "steering": (rigid[-1],) if rigid else None,
        "magnet": (last,),
        "drag": (free[-1],),
        "gust": (last,),
        "tide": (),
        "input": (free[0],),
    }
    usual, odd = (
        ["spring", "well", "torque", "follower"],
        ["damper", "steering", "magnet", "drag", "gust", "tide", "input"],
    )
    wanted = ["weight", usual[made.seed % 4], usual[int(draw.integers(4))]]
    if made.seed % 2:
        wanted += [odd[(made.seed // 2) % 7], odd[int(draw.integers(7))]]
    return tuple(Part(kind, on) for kind in dict.fromkeys(wanted) if (on := choices[kind]) is not None)


def generated(recipe, seed):
    """A scene of this structure with random parameters, assembled at its reference configuration."""
    draw = np.random.default_rng([recipe.seed, seed])
    n, rows = len(recipe.bodies), len(recipe.rows)
    kind = GeneratedWithOwnSpeeds if recipe.own_speeds else Generated
    scene = kind(
        recipe=recipe,
        masses=draw.uniform(0.5, 2.0, n),
        sides=draw.uniform(0.5, 1.0, (n, 3)),
        sizes=draw.uniform(0.4, 0.9, n),
        strengths=draw.uniform(0.5, 3.0, len(recipe.loads)),
        factors=draw.uniform(0.4, 1.2, rows),
        anchors=np.ones((rows, 3)),
        gravity=draw.uniform(3.0, 10.0),
    )
    return scene.replace(anchors=_anchors(scene, scene.reference())) if rows else scene


def _anchors(scene, q):
    """Lengths of rods and points of joints that assemble the scene at q."""
    pose = jj.pose_at(scene, 0.0, q)
    found = []
    for part in scene.recipe.rows:
        on = part.on[0] if part.kind in GEOMETRIC else 0
        own = pose[body_name(on)].place(jnp.stack([0.3, 0.1, -0.2]) * scene.sizes[on])
        held = jnp.ones(3)
        if part.kind == "rod":
            held = jnp.linalg.norm(
                own - scene.place(pose, part.on[1], jnp.stack([0.1, -0.2, 0.1]))
            ) * jnp.ones(3)
        elif part.kind in ("pin", "flat pin"):
            other = None if part.on[1] == GROUND else pose[body_name(part.on[1])]
            held = own if other is None else other.orientation.T @ (own - other.position)
        elif part.kind == "curve":
            r, s = pose[body_name(on)].position, scene.recipe.rows.index(part)
            held = (r[1] - scene.factors[s] * jnp.sin(r[0])) * jnp.ones(3)
        found.append(held)
    return jnp.stack(found)
