"""What must be refused, flagged or noticed: impossible bodies in lanes, changed files, starts outside the
domain, robot files with faults.

A case counts as right only where the truth exists and is met; otherwise the engine must say that something is
wrong.
"""

import json
import re
import tempfile
import tomllib
import warnings
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from figures import fresh
from small_scenes import OnPlane

import jourdain_jax as jj
from hunting.family import G, drawn, one_of, power
from hunting.pendulums import SphericalPendulum
from hunting.uses import Single, in_way, warnings_of
from jourdain_jax.studies import End, Uniform

WAYS = ("simulate", "jit", "rollout", "jit rollout")


def _asked(scene, parameters, start, way, **options):
    """The motion of a scene whose `parameters` are numbers, in one of the ways; of two lanes the second is
    the one that is meant.
    """
    one = lambda p: jj.simulate(scene.replace(**p), start, **options)

    def lanes(p):
        both = {name: jnp.stack([getattr(scene, name), value]) for name, value in p.items()}
        return jj.rollout(scene, start, parameters=both, **options).lanes

    return in_way(way, one, lanes, parameters)


# Impossible bodies. -----------------------------------------------------------------------------------------


def _beyond(x):
    """How far a parameter is beyond 1e4: nothing at its default, nor near it, where a scene is probed."""
    return jnp.maximum(x - 1e4, 0.0)


class Block(jj.Scene):
    """A block that slides and turns, under gravity along x; each parameter beyond 1e4 makes it impossible in
    a way of its own.
    """

    coordinates = jj.coordinates("x turn")
    above: object = jj.parameter(1.0)  # Ixy, not Iyx
    smallest: object = jj.parameter(1.0)
    largest: object = jj.parameter(1.0)
    scale: object = jj.parameter(1.0)  # of the orientation
    mirror: object = jj.parameter(1.0)
    down: object = jj.parameter(1.0)  # length of gravity's direction

    def bodies(self, t, q):
        inertia = jnp.array([[1.0, 0.1, 0.0], [0.1, 1.2, 0.0], [0.0, 0.0, 1.1]])
        inertia = inertia.at[0, 1].add(_beyond(self.above)).at[0, 0].add(-_beyond(self.smallest))
        inertia = inertia.at[2, 2].add(_beyond(self.largest))
        side = jnp.where(self.mirror > 1e4, -1.0, 1.0)
        turned = (1.0 + _beyond(self.scale)) * jj.rot_z(q.turn) * jnp.stack([1.0, 1.0, side])
        return {"block": jj.RigidBody(1.0, inertia, [q.x, 0.0, 0.0], turned)}

    def loads(self, motion):
        return jj.gravity(motion, G, (1.0 + _beyond(self.down)) * jnp.array([1.0, 0.0, 0.0]))


class Wheel(jj.Scene):
    """An upright wheel that rolls along x and steers, kept at the height of its radius by its coordinates."""

    coordinates = jj.coordinates("x y heading spin")
    radius: object = jj.parameter(1.0)  # of the contact, less
    height: object = jj.parameter(1.0)  # of the centre, more
    normal: object = jj.parameter(1.0)  # length of the normal of the ground
    flipped: object = jj.parameter(1.0)  # radius and height below zero

    def sizes(self):
        """Radius and height in m."""
        side = jnp.where(self.flipped > 1e4, -1.0, 1.0)
        return side * (0.3 - _beyond(self.radius)), side * (0.3 + _beyond(self.height))

    def ground(self):
        """The plane z = 0."""
        return jj.Plane(normal=(1.0 + _beyond(self.normal)) * jnp.array([0.0, 0.0, 1.0]))

    def bodies(self, t, q):
        at, turned = [q.x, q.y, self.sizes()[1]], jj.rot_z(q.heading) @ jj.rot_y(q.spin)
        return {"wheel": jj.RigidBody(1.0, jnp.array([0.03, 0.05, 0.03]), at, turned)}

    def contacts(self, pose):
        return {"floor": jj.disc_contact(pose["wheel"], self.sizes()[0], ground=self.ground())}


class BallAbove(Wheel):
    """A ball in place of the wheel."""

    def contacts(self, pose):
        return {"floor": jj.ball_contact(pose["wheel"], self.sizes()[0], ground=self.ground())}


class TyredWheel(Wheel):
    """A wheel with a tyre, which is below zero where `flipped`, and leaves the wheel its height."""

    def contacts(self, pose):
        tyre = jnp.where(self.flipped > 1e4, -0.05, 0.05)
        return {"floor": jj.wheel_contact(pose["wheel"], 0.3 - tyre, tyre)}

    def sizes(self):
        """Radius and height in m."""
        return 0.3, 0.3


IMPOSSIBLE = (
    ("inertia that is not symmetric", Block, "above", (0.1, 0.5)),
    ("negative moment", Block, "smallest", (1.1, 2.0)),
    ("moment above the sum of the others", Block, "largest", (1.2, 2.0)),
    ("scaled orientation", Block, "scale", (0.02, 1.0)),
    ("reflected orientation", Block, "mirror", (0.1, 1.0)),
    ("direction of gravity", Block, "down", (0.02, 2.0)),
    ("radius of a wheel that is not its height", Wheel, "radius", (0.02, 0.2)),
    ("ball off its ground", BallAbove, "height", (0.02, 0.3)),
    ("normal of the ground", BallAbove, "normal", (0.03, 1.0)),
    ("negative radius", Wheel, "flipped", (1.0, 2.0)),
    ("negative radius of a ball", BallAbove, "flipped", (1.0, 2.0)),
    ("negative tyre", TyredWheel, "flipped", (1.0, 2.0)),
)


def _impossible(seed):
    r = np.random.default_rng([seed, 90])
    what, scene, name, least_and_most = IMPOSSIBLE[seed % len(IMPOSSIBLE)]
    way, change = WAYS[seed // len(IMPOSSIBLE) % len(WAYS)], {name: 1e4 + r.uniform(*least_and_most)}
    start = {"turn_rate": 1.0} if scene is Block else {"spin_rate": 2.0}
    motion = _asked(scene(), change, start, way, t1=0.3)
    return f"{way}: {what}, {change}", np.inf, int(motion.result), warnings_of(motion)


# Rows that vanish with the speeds. --------------------------------------------------------------------------


class Lawful(OnPlane):
    """A particle in a plane whose speed is c(t) = 1 - t/stop; at rest its row has no slope, and nothing says
    where it goes.
    """

    stop: object = jj.parameter(1.0)
    pull: object = jj.parameter(1.0)
    power: object = jj.parameter(1.0)  # unit of the row

    def velocity_constraints(self, motion):
        u = motion.u
        return {"speed": self.power * (u.x_rate**2 + u.y_rate**2 - (1.0 - motion.t / self.stop) ** 2)}

    def loads(self, motion):
        return jj.gravity(motion, self.pull, (0.0, -1.0, 0.0))


def _at_rest(seed):
    r = np.random.default_rng([seed, 94])
    count, angle, way = int(r.integers(1, 60)), r.uniform(0, 2 * np.pi), WAYS[seed % len(WAYS)]
    ts = np.linspace(0, 2, count + 1)[1:]
    stops = one_of(r.choice(ts), (0.2, 1.9), (2.1, 4.0))
    parameters = drawn(stop=stops, pull=one_of(0.0, (0.1, 3)), power=power(-3, 3))(r)
    start = {"x_rate": np.cos(angle), "y_rate": np.sin(angle)}
    rtol, backend = float(10 ** r.uniform(-10, -4)), str(r.choice(["auto", "auto", "xla", "dense"]))
    motion = _asked(Lawful(), parameters, start, way, ts=ts, rtol=rtol, backend=backend)
    off = abs(np.hypot(*np.asarray(motion.u_end)) - (1 - 2 / parameters["stop"]))
    error = off / 1e-3 if parameters["stop"] > 2 else np.inf
    return f"{way}: {parameters}, {count} times, {backend}", error, int(motion.result), warnings_of(motion)


# Starts outside the domain. ---------------------------------------------------------------------------------


class CrankAndSlider(jj.Scene):
    """A crank and a slider in its line, joined by a rod; in its domain the slider is to the right of the
    crank, or below it.
    """

    coordinates = jj.coordinates("crank slide")
    length: object = jj.parameter(1.5)
    domain = {"crank": (-1.2, 1.2), "slide": (0.7, 2.6)}

    def bodies(self, t, q):
        pin = [jnp.cos(q.crank), jnp.sin(q.crank), 0.0]
        return {"pin": jj.Particle(1.0, pin), "slider": jj.Particle(1.0, [q.slide, 0.0, 0.0])}

    def geometric_constraints(self, pose):
        return {"rod": jj.rod(pose["pin"].position, pose["slider"].position, self.length)}


class Hanging(SphericalPendulum):
    """A pendulum in x, y, z that hangs."""

    domain = {"x": (-0.7, 0.7), "y": (-0.7, 0.7), "z": (-1.3, -0.3)}


def _outside(seed):
    """What `start` finds lies in the domain (a tenth of its width beyond is let pass), or it is refused."""
    r = np.random.default_rng([seed, 91])
    if seed % 2:
        scene, near = Hanging(length=r.uniform(0.8, 1.2)), {"x": (-0.5, 0.5), "y": (-0.5, 0.5)}
    else:
        scene, near = CrankAndSlider(length=r.uniform(1.25, 1.6)), {"crank": (-1.0, 1.0)}
    named = drawn(**near)(r)
    state = jj.start(scene, named)
    q = dict(zip(scene.coordinate_names.entries, np.asarray(state.q), strict=True))
    off = max(max(low - q[name], q[name] - high) / (high - low) for name, (low, high) in scene.domain.items())
    return f"start of {scene} with {named}: {q}", max(off, 0.0) / 0.1, 0, ""


# Robot files. -----------------------------------------------------------------------------------------------

TEXTS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
ARM, FAULTS = TEXTS["arm"], TEXTS["faults"]


def _heard(call):
    """What a call returns, and its warnings in one line."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        found = call()
    return found, "; ".join(str(w.message).splitlines()[0] for w in heard)


def _robot(seed):
    what, old, new = FAULTS[seed % len(FAULTS)]
    scene, said = _heard(lambda: jj.from_urdf(ARM.replace(old, new, 1)))
    return f"{what} in a URDF file: {scene.__name__}", np.inf, 0, said


# Files of studies. ------------------------------------------------------------------------------------------


@cache
def _study():
    path = Path(tempfile.mkdtemp()) / "discs.zarr"
    start, outputs = {"lean": Uniform(-0.5, 0.5), "spin_rate": -2.0}, {"lean": End("lean", "rad")}
    study = jj.Study(jj.models.TiltingDisc(), start=start, samples=64, seed=3)
    return path, _facts(study.run(path, t1=0.2, rtol=1e-6, atol=1e-6, outputs=outputs, progress=False))


def _facts(result):
    told = result.statistics
    numbers = {name: getattr(told, name) for name in ("mean", "covariance", "counts")}
    numbers |= {"edges": told.histogram("lean")[1], "values": result.to_xarray()["lean"].values}
    return {name: x.tolist() for name, x in numbers.items()} | {"complete": result.complete}


def _study_file(seed):
    """One character of one file of a study's folder is another: the study says so, or its numbers are what
    they were.
    """
    r = np.random.default_rng([seed, 92])
    path, before = _study()
    files = sorted(p for p in path.rglob("*") if p.is_file() and p.stat().st_size and "lock" not in p.name)
    kind_of = lambda file: re.sub(r"\d+", "0", str(file.relative_to(path)))
    kinds = sorted({*map(kind_of, files)})
    kind = kinds[seed % len(kinds)]
    changed = r.choice([file for file in files if kind_of(file) == kind])
    whole = changed.read_bytes()
    digits = [k for k, byte in enumerate(whole) if 48 <= byte <= 57]
    at = int(r.choice(digits or range(len(whole))))
    other = 48 + (whole[at] - 48 + int(r.integers(1, 10))) % 10 if digits else whole[at] ^ 1
    changed.write_bytes(whole[:at] + bytes([other]) + whole[at + 1 :])
    try:
        (after, shown), said = _heard(lambda: (_facts(result := jj.load_study(path)), str(result)))
    finally:
        changed.write_bytes(whole)
    said = said or ("" if after["complete"] else shown.splitlines()[0])
    return f"byte {at} of {kind}", 0.0 if json.dumps(after) == json.dumps(before) else np.inf, 0, said


# Machine code on disk. --------------------------------------------------------------------------------------

TWO_MOTIONS = """
import json, warnings; warnings.simplefilter("ignore")
import jourdain_jax as jj
scenes = jj.models.VerticalDisc(), jj.models.ChaplyginSleigh()
motions = [jj.simulate(scene, jj.start(scene, heading_rate=0.7), t1=1.0) for scene in scenes]
print(json.dumps([motion.q_end.tolist() for motion in motions]))
"""


def _run_twice(folder):
    try:
        return fresh(TWO_MOTIONS, JOURDAIN_JAX_CACHE=str(folder))
    except RuntimeError as error:
        return str(error)


def _cache_file(seed):
    """Files of machine code are exchanged, torn, or hold something else: the next process returns the same
    motions.
    """
    r = np.random.default_rng([seed, 93])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o700)
        before = _run_twice(folder)
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        contents = [file.read_bytes() for file in files]
        how = ("exchanged", "torn", "other bytes", "one bit")[seed % 4]
        for k, file in enumerate(files):
            old = contents[k]
            at = int(r.integers(len(old)))
            changed = {
                "exchanged": contents[(k + 1) % len(files)], "torn": old[:at],
                "other bytes": old[:32] + r.bytes(len(old) - 32),
                "one bit": old[:at] + bytes([old[at] ^ (1 << int(r.integers(8)))]) + old[at + 1 :],
            }  # fmt: skip
            file.write_bytes(changed[how])
        after = _run_twice(folder)
    return f"{len(files)} files of machine code {how}", 0.0 if files and after == before else np.inf, 0, ""


FAMILIES = (
    Single(
        "impossible",
        "bodies, contacts and directions that cannot be, alone, in lanes and under `jit`",
        _impossible,
        48,
    ),
    Single("at-rest", "a row for the speed of a particle, which loses its slope at rest", _at_rest, 40),
    Single(
        "outside",
        "starts of linkages and pendulums, of which only some coordinates are named, against the domain",
        _outside,
        20,
    ),
    Single("robot-files", "URDF files with faults", _robot, len(FAULTS)),
    Single("cache-files", "machine code on disk that is exchanged or damaged", _cache_file, 8),
    Single("study-files", "a study one of whose files has another digit", _study_file, 60),
)
