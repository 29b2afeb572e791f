"""Malformed input to every public entry point, as one table: what is written, the kind of answer, and the
words it must contain.

The expressions are evaluated in the namespace of `PRELUDE`, without the run-time type checks of the other
tests, as a user sees them (`test_malformed_inputs.py`). Kinds: the name of an exception; `exit N`, an exit
code of the command line with its text; `result N`, a result code of a motion with its message; `FAILED`, a
check of `verify` with its culprit.
"""

PRELUDE = '''
import contextlib, io, json, os
import diffrax, equinox as eqx, jax, jax.numpy as jnp, numpy as np
import jourdain_jax as jj
from jourdain_jax.bicycle.parameter_files import read_bicycle
from jourdain_jax.cli import main
from jourdain_jax.models import (
    ChaplyginSleigh,
    DoublePendulumRods,
    FreeRigidBody,
    PendulumChain,
    TrailerChain,
)
from jourdain_jax.models.registry import model

nan, inf = float("nan"), float("inf")
o, two, eye = jnp.zeros(3), jnp.zeros(2), jnp.eye(3)


class Bead(jj.Scene):
    mass: object = jj.parameter(1.0, unit="kg", positive=True)
    stiffness: object = jj.parameter(2.0, unit="N/m", non_negative=True)
    coordinates = jj.coordinates("x y")
    inputs = jj.inputs("push")

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=motion.inputs.push),)


def described(**members):
    return type("Described", (Bead,), members)()


def shaped(mass, inertia, orientation=eye, position=None):
    """The bead as a rigid body."""
    at = lambda q: jnp.stack([q.x, q.y, 0.0 * q.x]) if position is None else position * jnp.ones(3)
    bead = lambda q: jj.RigidBody(mass, inertia, at(q), orientation)
    return described(bodies=lambda self, t, q: {"bead": bead(q)})


def looked_at(**members):
    return jj.structure_of(described(**members))


def answered(**members):
    """Accelerations of the bead at rest, some of whose methods answer wrongly."""
    return jj.accelerations(described(**members), 0.0, two, two)


def unchecked(field, value):
    """A load with a field that its own checks would not let pass."""
    return eqx.tree_at(
        lambda load: getattr(load, field), jj.Load(), value, is_leaf=lambda x: x is None or x == {}
    )


def held(**rows):
    """The bead with velocity rows."""
    named = lambda motion: {name: row(motion) for name, row in rows.items()}
    return described(velocity_constraints=lambda self, motion: named(motion))


def shell(line):
    """A command: its exit code and what it says."""
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(told):
        try:
            code = main(line.split())
        except SystemExit as ended:
            code = ended.code
    return f"exit {code}", told.getvalue()


def ended(scene, start, **options):
    """A motion: its result code and message."""
    motion = jj.simulate(scene, start, t1=0.1, ts=[0.0, 0.1], **options)
    return f"result {int(motion.result)}", motion.message


def lanes_ended(starts, **options):
    """A rollout: the result code of its last lane, and what is printed."""
    lanes = jj.rollout(b, starts, t1=0.1, ts=[0.0, 0.1], progress=False, **options)
    return f"result {int(lanes.result[-1])}", str(lanes)


def rewritten(name, **changes):
    """A trajectory file with some arrays, or entries of its header, changed or (None) left out."""
    header = HEADER | {key: value for key, value in changes.items() if key in HEADER}
    arrays = ARRAYS | {
        "header": np.array(json.dumps({key: value for key, value in header.items() if value is not None}))
    }
    arrays |= {
        key.replace("parameter_", "parameter:"): value for key, value in changes.items() if key not in HEADER
    }
    np.savez(name, **{key: value for key, value in arrays.items() if value is not None})
    return name


def bicycle(line="", **changes):
    """A measured bicycle's file with a line more, or with values changed."""
    text = RIGID + line
    for name, value in changes.items():
        text = "".join(
            f"{name} = {value}\\n" if row.startswith(f"{name} =") else row
            for row in text.splitlines(keepends=True)
        )
    with open("mine.txt", "w") as file:
        file.write(text)
    return "mine.txt"


b, sleigh, chain = Bead(), ChaplyginSleigh(), TrailerChain()
several = jax.vmap(lambda mass: Bead(mass=mass))(jnp.array([1.0, 2.0, 3.0]))
pose, moving = jj.pose_at(b, 0.0, two), jj.motion_at(b, 0.0, two, two)
body = jj.pose_at(shaped(1.0, jnp.ones(3)), 0.0, two)["bead"]
bead, rest, fixed = pose["bead"], jj.start(b), jj.fixed_point(o)
run = jj.simulate(b, {"x_rate": 1.0}, t1=0.1, ts=[0.0, 0.1])
lanes = jj.rollout(b, {"x_rate": np.array([0.5, 0.6])}, t1=0.1, ts=[0.0, 0.1], progress=False)
data = jj.Experiment([0.0, 0.1], {"x": [0.0, 0.1]}, 0.01, start={})
jj.save(run, "run.npz")
WHOLE = open("run.npz", "rb").read()
ARRAYS = dict(np.load("run.npz"))
HEADER = json.loads(str(ARRAYS["header"]))
open("half.npz", "wb").write(WHOLE[: len(WHOLE) // 2])
open("empty.npz", "wb").close()
open("text.npz", "w").write("no trajectory")
from jourdain_jax.bicycle.parameter_files import shipped_bicycles

RIGID = shipped_bicycles()["Rigid"].read_text()
'''

Case = str | tuple[str, str]  # words in the text of a ValueError; or another kind of answer, and words in it

BODIES: dict[str, Case] = {
    "jj.Particle(jnp.ones(2), o)": "mass of a particle has shape (2,), expected one number",
    "jj.Particle(1j, o)": "mass of a particle is of type complex128, expected real numbers",
    "jj.Particle(True, o)": "mass of a particle is of type bool, expected real numbers",
    "jj.Particle(1.0, [1.0, 'a', 2.0])": "position of a particle is a list, expected real numbers",
    "jj.RigidBody(1.0, jnp.ones(4), o, eye)": (
        "inertia of a rigid body has shape (4,), expected (3, 3); give three principal moments"
    ),
    "jj.RigidBody(1.0, None, o, eye)": "inertia of a rigid body is `None`, expected real numbers",
    "jj.RigidBody(1.0, jnp.ones(3), o, 'upright')": (
        "orientation of a rigid body is the text 'upright', expected real numbers"
    ),
    "jj.RigidBody.thin_disc(1.0, 'wide', axis='y', position=o, orientation=eye)": (
        "radius of a disc is the text 'wide', expected real"
    ),
    "jj.RigidBody.thin_disc(1.0, jnp.ones(2), axis='y', position=o, orientation=eye)": (
        "radius of a disc has shape (2,), expected one"
    ),
    "jj.RigidBody.thin_disc(1.0, 0.5, axis=eye[1], position=o, orientation=eye)": (
        "body axis `[0. 1. 0.]` is unknown; expected one of `x`, `y`, `z`"
    ),
    "jj.RigidBody.thin_disc(1.0, 0.5, axis=1, position=o, orientation=eye)": (
        "body axis `1` is unknown; expected one of `x`, `y`, `z`"
    ),
    "jj.RigidBody.ball(1.0, None, position=o, orientation=eye)": (
        "radius of a ball is `None`, expected real numbers"
    ),
    "jj.RigidBody.ball(1.0, 0.1, position=o, orientation=eye, factor='solid')": (
        "factor of a ball is the text 'solid', expected real"
    ),
    "jj.RigidBody.rod(1.0, 'long', axis='x', position=o, orientation=eye)": (
        "length of a rod is the text 'long', expected real numbers"
    ),
    "jj.RigidBody.box(1.0, (1.0, 2.0), position=o, orientation=eye)": (
        "sides of a box has shape (2,), expected (3,); give three lengths"
    ),
    "jj.RigidBody.box(1.0, 3.0, position=o, orientation=eye)": (
        "sides of a box has shape (), expected (3,); give three lengths, m"
    ),
    "jj.structure_of(shaped(0.0, jnp.ones(3)))": (
        "nothing in `Described` has inertia along `x_rate`: no mass moves with it"
    ),
    "jj.structure_of(shaped(nan, jnp.ones(3)))": (
        "body `bead` of `Described` has no finite mass at any probed state"
    ),
    "jj.structure_of(shaped(1.0, [nan, 1.0, 1.0]))": (
        "body `bead` of `Described` has no finite inertia at any probed state"
    ),
    "jj.structure_of(shaped(1.0, jnp.ones(3), position=nan))": (
        "body `bead` of `Described` has no finite position at any probed state"
    ),
    "jj.structure_of(shaped(1.0, jnp.ones(3), nan * eye))": (
        "body `bead` of `Described` has no finite orientation at any probed state"
    ),
    "jj.build(shaped(1.0, [1.0, 1.0, 5.0]))": (
        "body `bead` of `Described` has principal moments of inertia 1, 1 and 5 kg m^2, the last above the "
        "sum of the others: no distribution of mass has them"
    ),
}

PARAMETERS: dict[str, Case] = {
    "Bead(mass=0)": (
        "parameter `mass` of `Bead` is 0.0, expected a positive number in kg; give a value above zero"
    ),
    "Bead(mass=inf)": (
        "parameter `mass` of `Bead` is inf, expected finite numbers; check where it was computed"
    ),
    "Bead(mass='heavy')": (
        "parameter `mass` of `Bead` is the text 'heavy', expected a number in kg or an array of numbers"
    ),
    "Bead(mass=2 + 1j)": "parameter `mass` of `Bead` is the complex number (2+1j), expected a number in kg",
    "Bead(mass=jnp.array(2 + 1j))": (
        "parameter `mass` of `Bead` is of type complex128, expected real numbers in kg"
    ),
    "b.replace(mass=True)": "parameter `mass` of `Bead` is a bool, expected a number in kg",
    "Bead(mass=None)": "parameter `mass` of `Bead` is `None`, expected a number in kg",
    "Bead(stiffness=-1.0)": (
        "parameter `stiffness` of `Bead` is -1.0, expected a number >= 0 in N/m; give a value that is not"
        " negative"
    ),
    "Bead(mas=1.0)": (
        "scene `Bead` has no parameter `mas`; did you mean `mass`? Valid names: `mass`, `stiffness`."
    ),
    "b.replace(mass=[1.0, -2.0])": "parameter `mass` of `Bead` is [ 1. -2.], expected a positive number",
    "b.replace(mass=nan)": "parameter `mass` of `Bead` is nan, expected finite numbers",
    "b.replace(stifness=1.0)": "scene `Bead` has no parameter `stifness`; did you mean `stiffness`?",
    "b.replace(coordinates=1.0)": (
        "scene `Bead` has no parameter `coordinates`; valid names: `mass`, `stiffness`."
    ),
    "jj.simulate(b.replace(mass=jnp.ones(2)), {}, t1=0.1)": (
        "mass of a particle has shape (2,), expected one number"
    ),
    "PendulumChain(links=2.5)": (
        "`links` of `PendulumChain` is 2.5, expected a whole number of particles >= 1"
    ),
    "TrailerChain(trailers='three')": "`trailers` of `TrailerChain` is 'three', expected a whole number >= 0",
    "model('skat')": "unknown model `skat`; did you mean `skate`?",
    "model('skate', mas=1.0)": "model `skate` has no parameter `mas`; did you mean `mass`?",
}

NAMES: dict[str, Case] = {
    "jj.coordinates()": "`coordinates` was given no name; give at least one, such as jj.coordinates('x y')",
    "jj.coordinates(3)": (
        "`coordinates` was given an int, expected names in one text, separated by spaces: jj.coordinates('a"
        " b c')"
    ),
    "jj.coordinates(['x', 'y'])": "`coordinates` was given a list, expected names in one text",
    "jj.coordinates('x y', 'x')": "coordinate name `x` is used twice; every coordinate needs its own name",
    "jj.coordinates('1x')": "coordinate name `1x` is not an identifier; use letters, digits and underscores",
    "jj.coordinates('for')": "coordinate name `for` is a keyword of Python, so `q.for` cannot be written",
    "jj.coordinates('array')": "coordinate name `array` is reserved: `q.array` already has a meaning",
    "jj.coordinates(jj.quaternion('a b'))": "coordinate name `a b_w` is not an identifier",
    "jj.quaternion(3)": (
        "the name of a quaternion is an int, expected a text, such as jj.quaternion('attitude')"
    ),
    "jj.speeds(['a', 'b'])": (
        "`speeds` was given a list, expected names in one text, separated by spaces: jj.speeds('a b c')"
    ),
    "jj.speeds('a a')": "speed name `a` is used twice",
    "jj.inputs(None)": "`inputs` was given `None`, expected names in one text",
    "type('S', (jj.Scene,), {'coordinates': 'x y'})()": (
        "scene `S` has no `coordinates`; state them as a class attribute"
    ),
    "described(inputs='push')": (
        "`inputs` of `Described` is the text 'push', expected names; write inputs = jj.inputs('a b c')"
    ),
    "described(speeds=jj.speeds('a b'))": (
        "`Described` defines speeds (a, b) but not the rates of its coordinates"
    ),
    "described(domain={'z': (0.0, 1.0)})": (
        "`domain` of `Described` names `z`, which is not a coordinate or speed"
    ),
    "described(domain={'x': (nan, 0.0)})": (
        "`domain` of `Described` gives (nan, 0.0) for `x`, expected two finite numbers (low, high)"
    ),
    "described(domain={'x': (0, 'a')})": (
        "`domain` of `Described` gives (0, 'a') for `x`, expected two finite numbers"
    ),
    "described(example={'z': 1.0})": "`example` of `Described` names `z`, which is not a coordinate or speed",
    "described(loads=lambda self, t, q, u: ())": (
        "`loads` of `Described` takes (self, t, q, u), expected (self, motion)"
    ),
    "described(geometric_constraints=lambda pose: {})": (
        "`geometric_constraints` of `Described` takes (pose), expected (self, pose)"
    ),
    "described(load=lambda self, motion: ())": (
        "`Described` has a method `load`, which nothing calls; did you mean `loads`?"
    ),
    "looked_at(privileged=('x_rate',))": (
        "`privileged` of `Described` names 1 speeds, but the scene has 2 degrees of freedom"
    ),
    "looked_at(privileged=('x_rate', 'z_rate'))": (
        "unknown privileged speed of `Described`: `z_rate`; did you mean `y_rate`?"
    ),
    "looked_at(privileged=('x_rate', 'x_rate'))": (
        "`privileged` of `Described` names a speed twice (x_rate, x_rate)"
    ),
    "looked_at(privileged=3)": "`privileged` of `Described` is an int, expected names of speeds",
    "b.named(z=1.0)": (
        "scene `Bead` has no coordinate or speed `z`; valid names: `x`, `y`, `x_rate`, `y_rate`."
    ),
    "b.named(x=[1.0, 2.0])": (
        "`x` was given an array of shape (2,), expected one number; use `jax.vmap` or `rollout` for many"
    ),
    "b.named(x='far')": "`x` is the text 'far', expected real numbers; give its value",
    "FreeRigidBody().named(attitude=[1.0, 0.0])": (
        "`attitude` was given an array of shape (2,), expected (4,)"
    ),
}

PARTS: dict[str, Case] = {
    "jj.rot_x('a')": "angle of a rotation is the text 'a', expected real numbers; pass one angle in rad",
    "jj.rot_z(jnp.ones(2))": "angle of a rotation has shape (2,), expected one number",
    "jj.quaternion_to_matrix([1.0, 0.0])": "quaternion has shape (2,), expected (4,); pass (w, x, y, z)",
    "jj.quaternion_from_axis_angle([1.0, 0.0], 0.3)": (
        "axis of a quaternion has shape (2,), expected (3,); pass a unit vector"
    ),
    "jj.rod(o, o, 'long')": "length of a rod is the text 'long', expected real numbers; give it in m",
    "jj.rod(o, eye[0], 0.0)": (
        "length of a rod is 0.0, expected positive numbers; give it in m; to keep two points together use"
        " `jj.pin`"
    ),
    "jj.rod(o, eye[0], -1.0)": "length of a rod is -1.0, expected positive numbers",
    "jj.rod(o, two, 1.0)": (
        "second point of a rod has shape (2,), expected (3,); give three components in the inertial frame, m"
    ),
    "jj.pin(two, o)": "first point of a pin has shape (2,), expected (3,)",
    "jj.pin(o, o, axes=3)": "`axes` of a pin is `3`, expected letters out of `xyz`",
    "jj.pin(o, o, axes='')": "`axes` of a pin is ``, expected letters out of `xyz`, such as `xyz` or `xy`",
    "jj.knife_edge(moving['bead'], two, o)": (
        "contact of the knife edge of `bead` has shape (2,), expected (3,)"
    ),
    "jj.knife_edge(moving['bead'], o, two)": (
        "lateral direction of the knife edge of `bead` has shape (2,), expected (3,); give a unit vector"
    ),
    "jj.weld(bead, bead, turn=two)": "turn of a weld has shape (2,), expected (3, 3); give a rotation matrix",
    "jj.weld(bead, o)": (
        'the second body of a weld is an array of shape (3,), expected the pose of a body; write pose["name"]'
    ),
    "jj.Plane(tilt='steep')": (
        "tilt of a plane is the text 'steep', expected real numbers; give one angle in rad"
    ),
    "jj.Plane(velocity=1.0)": "velocity of a plane has shape (), expected (3,)",
    "jj.disc_contact(bead, 0.5)": (
        "body `bead` of a contact is a particle, which cannot roll; make it a `jj.RigidBody`"
    ),
    "jj.ball_contact(jj.pose_at(shaped(1.0, jnp.ones(3)), 0.0, two)['bead'], 0.5, ground=3.0)": (
        "`ground` of the contact of `bead` is a float, expected a `jj.Plane(...)`, `jj.Cylinder`,"
        " `jj.Sphere`, `jj.Surface` or `jj.HeightMap`, or None"
    ),
    "jj.Contact('bead', o, carried='bead')": (
        "`carried` of the contact of `bead` is the text 'bead', expected names of bodies; write (\"bead\",)"
    ),
    "jj.disc_contact(bead, 0.5, height='rows')": "contact height `rows` is unknown; expected `coordinates`",
    "jj.ball_contact(b, 0.5)": "the body of a contact is a Bead, expected the pose of a body",
    "jj.ball_contact(jj.pose_at(shaped(1.0, jnp.ones(3)), 0.0, two)['bead'], 0.5, ground='ground')": (
        "`ground` of the contact of `bead` is the text 'ground', expected a `jj.Plane(...)`"
    ),
    "jj.fixed_point('origin')": "position of a fixed point is the text 'origin', expected real numbers",
    "moving['bead'].velocity_at([1.0, 2.0])": (
        "point of body `bead` has shape (2,), expected (3,); give three components in the inertial frame"
    ),
    "moving['bead'].point([1.0])": (
        "point of body `bead` has shape (1,), expected (3,); give three components in its body frame, m"
    ),
    "moving['bed']": (
        "UnknownNameError",
        "no body `bed` in this scene; did you mean `bead`? Valid names: `bead`.",
    ),
    "pose.q.z": ("AttributeError", "no entry `z`; valid names: `x`, `y`."),
    "jj.gravity(b, 9.81)": (
        "`gravity` was given a Bead, expected a motion: the argument of `loads(self, motion)`"
    ),
    "pose.q[0]": ("TypeError", "`0` was given, but entries are accessed by name; write `q.yaw`"),
    "jj.gravity(moving, [9.81])": "strength of gravity has shape (1,), expected one number",
    "jj.spring(o, fixed, 1.0)": (
        'first end of a spring is an array of shape (3,), expected a point: motion["name"].point(local) or'
    ),
    "jj.spring(fixed, fixed, 'k')": "stiffness of a spring is the text 'k', expected real numbers",
    "jj.spring(fixed, fixed, jnp.ones(3))": "stiffness of a spring has shape (3,), expected one number",
    "jj.damper(fixed, 'wall', 1.0)": "second end of a damper is the text 'wall', expected a point",
    "jj.damper(fixed, fixed, None)": "damping of a damper is `None`, expected real numbers",
    "jj.torque(moving, 'bed', o)": "torque on unknown body `bed`; did you mean `bead`?",
    "jj.torque(moving, 'bead', o, reaction='wall')": "torque on unknown body `wall`; valid names: `bead`.",
    "jj.point_force(o, o)": "point of a force is an array of shape (3,), expected a point",
    "jj.point_force(moving['bead'].point(), [1.0])": (
        "force on a point of `bead` has shape (1,), expected (3,)"
    ),
    "jj.generalized_force(moving, x=1.0)": (
        "generalized force on unknown speed `x`; valid names: `x_rate`, `y_rate`."
    ),
    "jj.Load(forces=[o])": "`forces` of a load is a list, expected a dictionary by name",
    "jj.Load(forces={'bead': 'hard'})": "load on `bead` is the text 'hard', expected real numbers",
    "looked_at(loads=lambda self, m: (jj.Load(forces={'bed': (0.0, 0.0, 1.0)}),))": (
        "acts on unknown body `bed`"
    ),
    "jj.Load(potential='high')": "potential of a load is the text 'high', expected real numbers",
}

ROWS: dict[str, Case] = {
    "looked_at(geometric_constraints=lambda self, p: {'a': p.q.x - 1.0, 'b': p.q.x - 2.0})": (
        "no admissible state of `Described` was found"
    ),
    "looked_at(geometric_constraints=lambda self, p: {'a': 0.0 * p.q.x + 1.0})": (
        "positions miss the geometric constraints by 1.0e+00 or more"
    ),
    "looked_at(geometric_constraints=lambda self, p: {'a': nan * p.q.x})": (
        "no admissible state of `Described` was found"
    ),
    "looked_at(prescribed=lambda self, t: {'z': t})": (
        "unknown prescribed coordinate of `Described`: `z`; valid names: `x`, `y`."
    ),
    "jj.structure_of(held(a=lambda m: nan * m.u.x_rate))": (
        "constraints `a` of `Described` are not finite at any probed state, expected numbers"
    ),
    "jj.start(held(a=lambda m: m.u.x_rate - 1.0, b=lambda m: m.u.x_rate - 2.0))": (
        "constraints `a`, `b` of `Described` contradict each other"
    ),
    "jj.simulate(held(a=lambda m: m.u.x_rate, b=lambda m: 2.0 * m.u.x_rate - m.t), {}, t1=1.0)": (
        "constraints `a`, `b` of `Described`"
    ),
    "jj.simulate(held(a=lambda m: m.u.x_rate, b=lambda m: m.u.x_rate - m.q.y), {}, t1=1.0)": (
        "constraints `a`, `b` of `Described`"
    ),
    "jj.simulate(held(a=lambda m: m.q.x), {'x_rate': 1.0}, t1=1.0)": (
        "velocity constraint `a` of `Described` depends on no speed and is not zero"
    ),
    "jj.accelerations(held(a=lambda m: None), 0.0, two, two)": (
        "constraint `a` of `Described` is `None`, expected real numbers"
    ),
    "jj.accelerations(held(a=lambda m: m.u.x_rate > 0), 0.0, two, two)": (
        "constraint `a` of `Described` is of type bool, expected real numbers"
    ),
    "jj.accelerations(described(contacts=lambda self, p: {'rim': 1.0}), 0.0, two, two)": (
        "contact `rim` of `Described` is a float, expected a"
    ),
}

STATES: dict[str, Case] = {
    "jj.start(Bead)": (
        "`scene` is the class `Bead`, expected an instance; write `Bead()`, with parameters in the"
        " parentheses"
    ),
    "jj.start(b, 3.0)": (
        "`start` was given a float, expected named values: `jj.start(scene, lean=0.3)`, or a dictionary of"
        " them"
    ),
    "jj.start(b, z=1.0)": "scene `Bead` has no coordinate or speed `z`",
    "jj.start(b, x=nan)": "start value `x` is nan, expected a finite number; check where it was computed",
    "jj.start(b, t0='noon')": "`t` is the text 'noon', expected real numbers; give one time in s",
    "jj.start(b, t0=nan)": "start value `t0` is nan, expected a finite number",
    "jj.start(sleigh, x_rate=0.0, y_rate=1.0, heading=0.0, heading_rate=0.0)": (
        "the start of `ChaplyginSleigh` violates constraint `blade`"
    ),
    "jj.start(DoublePendulumRods(), x1=5.0, z1=5.0)": (
        "the start of `DoublePendulumRods` violates constraint `upper rod`: residual"
    ),
    "jj.consistent(b, 0.0, [1.0], two)": (
        "`q` of `Bead` has shape (1,), expected (2,); one number for each of x, y"
    ),
    "jj.consistent(b, 0.0, two, two, held=('z',))": (
        "`held` names `z`, which is not a coordinate or speed; valid names: `x`, `y`, `x_rate`, `y_rate`."
    ),
    "jj.accelerations(Bead, 0.0, two, two)": "`scene` is the class `Bead`, expected an instance",
    "jj.equations.lagrange_equations(Bead, 0.0, two, two)": (
        "`scene` is the class `Bead`, expected an instance"
    ),
    "jj.pose_at(Bead, 0.0, two)": "`scene` is the class `Bead`, expected an instance",
    "jj.sample_states(Bead, 3)": "`scene` is the class `Bead`, expected an instance",
    "jj.linearize(b, jj.steady(b, {}))": (
        "`state` is a SteadyMotion, expected a State (from `jj.start` or `jj.consistent`), a dictionary of"
    ),
    "jj.accelerations(several, 0.0, two, two)": (
        "`Bead` cannot be evaluated: its `mass` has the shape (3,), `stiffness` has the shape (3,)"
    ),
    "jj.simulate(several, {'x': 1.0}, t1=1.0)": (
        "for many scenes use `jax.vmap`, or `rollout` with `parameters="
    ),
    "jj.accelerations(b, 'now', two, two)": (
        "`t` is the text 'now', expected real numbers; give one time in s"
    ),
    "jj.accelerations(b, two, two, two)": (
        "`t` has shape (2,), expected one number; give one time in s; use `jax.vmap` for many"
    ),
    "jj.accelerations(b, 0.0, two, 'fast')": (
        "`u` of `Bead` is the text 'fast', expected real numbers; one number for each of x_rate, y_rate"
    ),
    "jj.accelerations(b, 0.0, two, two, {'pull': 1.0})": "`Bead` has no input `pull`; did you mean `push`?",
    "jj.accelerations(b, 0.0, two, two, [1.0, 2.0])": (
        "`inputs` of `Bead` has shape (2,), expected (1,); one number for each of push"
    ),
    "jj.accelerations(b, 0.0, two, two, {'push': lambda t: t})": (
        "input `push` of `Bead` is a function, expected real numbers; give its value at this instant"
    ),
    "jj.accelerations(b, 0.0, two, two, reduction='rq')": "unknown reduction `rq`; did you mean `qr`?",
    "jj.accelerations(b, 0.0, two, two, reduction=jj.equations.NullSpaceQR)": (
        "`reduction` is the class `NullSpaceQR`, expected a name (privileged, qr,"
    ),
    "jj.accelerations(b, 0.0, two, two, reduction=jj.equations.Privileged((0, 7)))": (
        "`independent` is (0, 7), expected indices of speeds of `Bead`"
    ),
    "jj.accelerations(b, 0.0, two, two, reduction=jj.equations.Privileged(('x_rate',)))": (
        "`independent` is ('x_rate',), expected indices of speeds"
    ),
    "jj.accelerations(b, 0.0, two, two, stabilisation=5.0)": (
        "`stabilisation` is a float, expected `jj.Baumgarte(alpha, beta)` or None"
    ),
    "jj.Baumgarte(alpha='hard')": "`alpha` of `Baumgarte` is the text 'hard', expected real numbers",
    "jj.equations.kinetic_energy(b, 0.0, two, [1.0])": "`u` of `Bead` has shape (1,), expected (2,)",
    "jj.equations.potential_energy(b, None)": (
        "`motion` is `None`, expected a motion, such as `jj.motion_at(scene, t, q, u)`"
    ),
    "jj.equations.gibbs_function(b, 0.0, two, two, [1.0])": "`udot` of `Bead` has shape (1,), expected (2,)",
    "jj.equations.lagrange_equations(FreeRigidBody(), 0.0, jnp.zeros(7), jnp.zeros(6))": (
        "Lagrange's equations hold for coordinate rates, and the speeds of"
    ),
    "jj.virtual_power(b, 0.0, two, two, two, [1.0])": (
        "`virtual_velocity` of `Bead` has shape (1,), expected (2,)"
    ),
    "jj.newton_residual(b, 0.0, two, two, [1.0])": "`udot` of `Bead` has shape (1,), expected (2,)",
    "jj.equations.constraint_rows(b, 0.0, {'x': 1.0}, two)": (
        "`q` of `Bead` is a dictionary, expected a vector of x, y; `jj.start(scene, **values)` makes one"
    ),
    "jj.equations.velocity_residual(b, 0.0, two, None)": "`u` of `Bead` is `None`, expected real numbers",
    "jj.equations.coordinate_rates(b, 0.0, two, jnp.ones((3, 2)))": (
        "`u` of `Bead` has shape (3, 2), expected (2,); one number for each of x_rate, y_rate"
    ),
    "jj.pose_at(b, 0.0, [[0.0, 0.0]])": "`q` of `Bead` has shape (1, 2), expected (2,)",
    "jj.sample_states(b, 0)": "`count` is 0, expected a whole number of states, at least 1",
    "jj.sample_states(b, 2.5)": "`count` is 2.5, expected a whole number of states",
    "jj.sample_states(b, 4, seed='x')": "`seed` is 'x', expected a whole number that is not negative",
    "jj.analysis.derivative_exists(b, 0.0, two, two, 3, two)": "`direction` is an int, expected a",
    "jj.structure_of(Bead)": "`scene` is the class `Bead`",
    "jj.reductions(3)": "`scene` is an int, expected a scene: an instance of a subclass of `jj.Scene`",
    "jj.lower(3)": "`scene` is an int, expected a scene",
}

MOTIONS: dict[str, Case] = {
    "jj.simulate(b, {}, t1=1.0, inputs={'push': lambda t: jnp.exp(1j * t)})": (
        "input `push` of `Bead` returned a number of type complex128, expected a real number"
    ),
    "jj.simulate(Bead, {}, t1=1.0)": "`scene` is the class `Bead`, expected an instance; write `Bead()`",
    "jj.simulate(3.0, {}, t1=1.0)": (
        "`scene` is a float, expected a scene: an instance of a subclass of `jj.Scene`"
    ),
    "jj.simulate(b, 3.0, t1=1.0)": (
        "`start` is a float, expected a State (from `jj.start` or `jj.consistent`), a dictionary of named"
        " values, or None"
    ),
    "jj.simulate(b, jj.start(sleigh), t1=0.1)": "`q` of `Bead` has shape (3,), expected (2,)",
    "jj.simulate(b, jax.tree.map(lambda x: jnp.stack([x, x]), rest), t1=0.1)": (
        "`start` holds a batch of shape (2,); use `jj.rollout`"
    ),
    "jj.simulate(b, rest, t1=0.0)": (
        "the span from t0 = 0.0 to t1 = 0.0 s is empty or not finite; pass a finite `t1` different from `t0`"
    ),
    "jj.simulate(b, rest, t0=1.0, t1=1.0)": "the span from t0 = 1.0 to t1 = 1.0 s is empty",
    "jj.simulate(b, rest, t1=inf)": "the span from t0 = 0.0 to t1 = inf s is empty or not finite",
    "jj.simulate(b, rest, t1='later')": "`t1` is the text 'later', expected real numbers; give one time in s",
    "jj.simulate(b, rest, t1=[1.0, 2.0])": "`t1` has shape (2,), expected one number; give one time in s",
    "jj.simulate(described(example_span=nan), {})": (
        "the span from t0 = 0.0 to t1 = nan s is empty or not finite"
    ),
    "jj.simulate(b, rest, ts=[])": "`ts` has shape (0,), expected a vector of at least one time in s",
    "jj.simulate(b, rest, ts='all')": (
        "`ts` is the text 'all', expected real numbers; give a vector of times in s"
    ),
    "jj.simulate(b, rest, ts=[0.0, 0.5, 0.2])": (
        "`ts` must be finite and strictly increasing (or decreasing, for reversed time)"
    ),
    "jj.simulate(b, rest, ts=[0.0, nan])": "`ts` must be finite and strictly increasing",
    "jj.simulate(b, rest, ts=[0.0, 2.0], t1=1.0)": (
        "`ts` runs from 0.0 to 2.0 s, outside the span from t0 = 0.0 to t1 = 1.0 s"
    ),
    "jj.simulate(b, rest, ts=[1.0, 0.5], t1=2.0)": (
        "`ts` runs from 1.0 to 0.5 s, outside the span from t0 = 0.0 to t1 = 2.0 s or in the opposite"
        " direction"
    ),
    "jj.simulate(b, {}, t1=1.0, rtol=nan)": (
        "`rtol` is nan, expected a positive finite number; pass a tolerance such as 1e-8"
    ),
    "jj.simulate(b, {}, t1=1.0, options={'rtol': 1e-8})": "`options` is a dict, expected `jj.Options(...)`",
    "jj.simulate(b, {}, t1=1.0, rtol='tight')": (
        "`rtol` is the text 'tight', expected real numbers; pass one number, such as 1e-8"
    ),
    "jj.simulate(b, {}, t1=1.0, atol=-1)": "`atol` is -1, expected a positive finite number",
    "jj.simulate(b, {}, t1=1.0, atol=[1e-8, 1e-8])": "`atol` has shape (2,), expected one number",
    "jj.simulate(b, {}, t1=1.0, max_steps=0)": "`max_steps` is 0, expected a whole number of at least 1",
    "jj.simulate(b, {}, t1=1.0, max_steps=True)": (
        "`max_steps` is True, expected a whole number of at least 1"
    ),
    "jj.simulate(b, {}, t1=1.0, max_step=0.0)": "`max_step` is 0, expected a positive time in s",
    "jj.simulate(b, {}, t1=1.0, max_step=nan)": "`max_step` is nan, expected a positive time in s",
    "jj.simulate(b, {}, t1=1.0, solver='dopri5')": (
        "`solver` is the text 'dopri5', expected a solver object; write `diffrax.Dopri5()`"
    ),
    "jj.simulate(b, {}, t1=1.0, solver=diffrax.Tsit5)": (
        "`solver` is the class `Tsit5`, expected a solver object; write `diffrax.Tsit5()`"
    ),
    "jj.simulate(b, {}, t1=1.0, solver=jj.RadauIIA)": (
        "`solver` is the class `RadauIIA`, expected a solver object; write `jj.RadauIIA()`"
    ),
    "jj.simulate(b, {}, t1=1.0, solver=diffrax.ForwardMode())": (
        "`solver` is a ForwardMode, expected a solver object"
    ),
    "jj.simulate(b, {}, t1=1.0, formulation=jj.Formulation('minimum'))": (
        "unknown state form `minimum`; did you mean `minimal`?"
    ),
    "jj.simulate(b, {}, t1=1.0, formulation=jj.Formulation(None))": (
        "unknown state form `None`; valid names: `auto`, `minimal`, `full`."
    ),
    (
        "jj.simulate(held(a=lambda m: m.u.x_rate**2 + m.u.y_rate**2 - 1.0), {'x_rate': 1.0}, t1=1.0, "
        "formulation=jj.Formulation('minimal'))"
    ): (
        "constraints of `Described` are nonlinear in the speeds, so there is no minimal state; use"
        " jj.Formulation('full')"
    ),
    "jj.simulate(b, {}, t1=1.0, formulation=jj.Formulation(reduction='QR'))": (
        "unknown reduction `QR`; valid names: `privileged`, `qr`"
    ),
    "jj.Formulation(stabilisation=3.0)": (
        '`stabilisation` is a float, expected "projection", `jj.Baumgarte(alpha, beta)` or None'
    ),
    "jj.Formulation(stabilisation='yes')": "`stabilisation` is the text 'yes', expected \"projection\"",
    "jj.simulate(b, {}, t1=1.0, formulation='full')": (
        "`formulation` is the text 'full', expected `jj.Formulation(state, reduction, stabilisation)`"
    ),
    "jj.simulate(b, {}, t1=1.0, work='yes')": "`work` is the text 'yes', expected True or False",
    "jj.simulate(b, {}, t1=1.0, events='none')": "`events` is the text 'none', expected True or False",
    "jj.simulate(b, {}, t2=1.0)": ("TypeError", "unexpected keyword argument 't2'"),
    "jj.simulate(b, {}, t1=1.0, inputs=[1.0])": (
        "`inputs` is a list, expected a dictionary of numbers, functions of time, or `jj.Sampled` by name"
    ),
    "jj.simulate(b, {}, t1=1.0, inputs={'pull': 1.0})": "`Bead` has no input `pull`; did you mean `push`?",
    "jj.simulate(b, {}, t1=1.0, inputs={'push': 'hard'})": (
        "input `push` of `Bead` is the text 'hard', expected real numbers; pass a number, a"
    ),
    "jj.simulate(b, {}, t1=1.0, inputs={'push': lambda t: jnp.stack([t, t])})": (
        "input `push` of `Bead` returned an array of shape (2,), expected"
    ),
    "jj.simulate(b, {}, t1=1.0, inputs={'push': lambda t: None})": (
        "input `push` of `Bead` returned `None`, expected one number; pass a function of one"
    ),
    "jj.simulate(b, {}, t1=1.0, inputs={'push': lambda motion: -motion.q.x})": (
        "A controller that reads the state is a load: compute its force from `motion.q`"
    ),
    "jj.simulate(b, {}, t1=1.0, inputs={'push': lambda: 1.0})": (
        "input `push` of `Bead` cannot be called with a time"
    ),
    "ended(b, {}, inputs={'push': nan})": ("result 4", "the accelerations are not finite near the last time"),
    "jj.simulate(described(events=lambda self, m: {'out': m.q.x < 1.0}), {}, t1=0.1)": (
        "event `out` of `Described` is of type bool, expected real"
    ),
    "jj.simulate(described(events=lambda self, m: 1.0 - m.q.x), {}, t1=0.1)": (
        "`events` of `Described` returned an array of shape (), expected a dictionary"
    ),
    "jj.Sampled([0, 2, 1], [0, 1, 2])": (
        "the times of `Sampled` must be finite and increase from one to the next; sort the samples by time"
    ),
    "jj.Sampled([0, 1], [0, 1, 2])": (
        "`Sampled` was given times of shape (2,) and values of shape (3,), expected two vectors of one length"
    ),
    "jj.Sampled(0.0, 1.0)": "`Sampled` was given times of shape () and values of shape ()",
    "jj.Sampled([0, 1], [0, nan])": (
        "value 1 of `Sampled` is nan, expected finite numbers; omit missing samples"
    ),
    "jj.Sampled(['a'], [0])": "`ts` of `Sampled` is a list, expected real numbers; give times in s",
    "run['z']": (
        "UnknownNameError",
        "a trajectory of `Bead` has no `z`; valid names: `x`, `y`, `x_rate`, `y_rate`, `t`.",
    ),
    "run.point('bed')": ("UnknownNameError", "no body `bed` in this scene; did you mean `bead`?"),
}

BATCHES: dict[str, Case] = {
    "jj.rollout(Bead)": "`scene` is the class `Bead`",
    "jj.rollout(b, 3.0, t1=0.1)": "`starts` is a float, expected a dictionary by name",
    "jj.rollout(b, {'x': 1.0}, t1=0.1)": (
        "no lanes: pass at least one start value or parameter as an array with one entry per lane"
    ),
    "jj.rollout(b, {'x': []}, t1=0.1)": "no lanes: pass at least one start value or parameter",
    "jj.rollout(b, {'x': [1.0, 2.0]}, parameters={'mass': object()}, t1=0.1)": (
        "parameter `mass` is an object, expected real numbers; pass an array with one entry per lane; to vary"
        " a field that is a module"
    ),
    "jj.rollout(b, {'x': ['a', 'b']}, t1=0.1)": "start `x` is a list, expected real numbers",
    "jj.rollout(b, {'x': [1.0, 2.0], 'y': [1.0]}, t1=0.1)": (
        "lanes differ in number: start `x` has 2, start `y` has 1; pass arrays of one length"
    ),
    "jj.rollout(b, {'z': [1.0, 2.0]}, t1=0.1)": "scene `Bead` has no coordinate or speed `z`",
    "jj.rollout(b, rest, t1=0.1)": "`starts` has no axis of lanes; pass an array with one entry per lane",
    "jj.rollout(b, {'x': [1.0, 2.0]}, parameters=[1.0], t1=0.1)": (
        "`parameters` is a list, expected a dictionary by name"
    ),
    "jj.rollout(b, {'x': [1.0, 2.0]}, parameters={'mas': [1.0, 2.0]}, t1=0.1)": (
        "scene `Bead` has no parameter `mas`; did you mean `mass`?"
    ),
    "jj.rollout(b, {'x': [1.0, 2.0]}, parameters={'mass': 1.0}, t1=0.1)": (
        "parameter `mass` has no axis of lanes"
    ),
    "jj.rollout(b, {'x': [1.0, 2.0]}, parameters={'mass': 'heavy'}, t1=0.1)": (
        "parameter `mass` is the text 'heavy', expected real numbers"
    ),
    "jj.rollout(b, {'x': [1.0, 2.0]}, chunk=0, t1=0.1)": (
        "`chunk` is 0, expected a whole number of at least one lane"
    ),
    "jj.rollout(b, {'x': [1.0, 2.0]}, chunk=1.5, t1=0.1)": "`chunk` is 1.5, expected a whole number",
    "jj.rollout(b, {'x': [1.0, 2.0]}, t1=0.0)": "the span from t0 = 0.0 to t1 = 0.0 s is empty or not finite",
    "jj.rollout(b, {'x': [1.0, 2.0]}, ts=[0.2, 0.1, 0.3])": "`ts` must be finite and strictly increasing",
    "jj.diagnose(jj.rollout(b, {'x': [1.0, 2.0]}, t1=0.1))": (
        "`diagnose` was given a Rollout, expected a `Trajectory`; for a rollout pass one"
    ),
    "jj.rollout(b, {'x': [1.0, 2.0]}, t1=0.1, solver='tsit5')": (
        "`solver` is the text 'tsit5', expected a solver object; write `diffrax.Tsit5()`"
    ),
    "lanes_ended({'x_rate': [1.0, nan]})": (
        "result 8",
        "the start is not finite; check where its values were computed: lanes 1",
    ),
    "lanes_ended({'x_rate': [1.0, 2.0]}, parameters={'mass': [1.0, -1.0]})": (
        "result 7",
        "a parameter is not finite or has the wrong sign (`mass`): lanes 1",
    ),
    "lanes.lane(2)": ("IndexError", "lane 2 does not exist; this rollout has 2 lanes, 0 to 1"),
    "lanes['z']": ("UnknownNameError", "a trajectory of `Bead` has no `z`"),
    "lanes.quantiles('x', [2.0])": "`levels` are [2.0], expected a list of numbers from 0 to 1",
}

FILES: dict[str, Case] = {
    "jj.load_trajectory('nowhere.npz', Bead)": (
        "nowhere.npz: cannot be read (No such file or directory); pass the path of a trajectory file written"
        " by `save`"
    ),
    "jj.load_trajectory('half.npz', Bead)": (
        "`half.npz`: not a trajectory file written by `save` (File is not a zip file)"
    ),
    "jj.load_trajectory('empty.npz', Bead)": (
        "`empty.npz`: not a trajectory file written by `save` (File is not a zip file)"
    ),
    "jj.load_trajectory('text.npz', Bead)": "`text.npz`: not a trajectory file written by `save`",
    "jj.load_trajectory('.', Bead)": ".: cannot be read (Is a directory)",
    "jj.load_trajectory('a\\0b', Bead)": (
        "`path` is the text 'a\\x00b', expected the name of a file or folder"
    ),
    "jj.load_trajectory('x' * 5000, Bead)": "xx...: cannot be read (File name too long)",
    "jj.load_model(None, b)": "`path` is `None`, expected the name of a file or folder",
    "jj.load_model(3, b)": "`path` is an int, expected the name of a file or folder",
    "jj.load_study(['a'])": "`path` is a list, expected the name of a file or folder",
    "jj.load_study('x' * 5000)": "xx...` does not exist; give the folder of a study",
    "jj.Study(b, vary={'mass': [1.0, 2.0]}).run('a\\0b', t1=0.1)": "expected the name of a file or folder",
    "read_bicycle(None)": "`path` is `None`, expected the name of a file or folder",
    "jj.save(run, 'a\\0b')": "expected the name of a file or folder",
    "jj.save(run, '')": "cannot write ``: it is a folder",
    "jj.save(run, 'x' * 5000)": "File name too long",
    "jj.build(b).save('.')": "cannot write `.`: it is a folder; pass the name of a file in it",
    "jj.show(run, 3)": "`path` is an int, expected the name of a file or folder",
    "jj.load_trajectory(3.5, Bead)": "`path` is a float, expected the name of a file",
    "jj.load_trajectory('run.npz', 3)": (
        "`scene` is an int, expected the class of the simulated scene, or a scene of that class"
    ),
    "jj.load_trajectory('run.npz', ChaplyginSleigh)": (
        "`run.npz` holds a trajectory of `Bead`, expected `ChaplyginSleigh`; pass its class"
    ),
    "jj.load_trajectory(rewritten('noq.npz', q=None), Bead)": (
        "`noq.npz` lacks `q`; it is damaged or was not written by `save`"
    ),
    "jj.load_trajectory(rewritten('shape.npz', q=ARRAYS['q'][:, :1]), Bead)": (
        "`shape.npz` does not match its digest; it is damaged or was not written by `save`"
    ),
    "jj.load_trajectory(rewritten('later.npz', format=9), Bead)": (
        "`later.npz` has format 9, expected 1; read it with the version of jourdain-jax that wrote it"
    ),
    "jj.load_trajectory(rewritten('bare.npz', solver=None), Bead)": (
        "`bare.npz` lacks `solver`; it is damaged or was not written by `save`"
    ),
    "jj.load_trajectory(rewritten('headless.npz', header=None), Bead)": (
        "`headless.npz`: not a trajectory file written by `save` ("
    ),
    "jj.load_trajectory(rewritten('broken.npz', header=np.array('{')), Bead)": (
        "`broken.npz`: not a trajectory file written by `save` (Expecting property name"
    ),
    "jj.load_trajectory(rewritten('listed.npz', header=np.array('[1]')), Bead)": (
        "`listed.npz` has an invalid header"
    ),
    "jj.load_trajectory(rewritten('minus.npz', parameter_mass=np.array(-1.0)), Bead)": (
        "`minus.npz` does not match its digest"
    ),
    "jj.save(run, 'nowhere/run.npz')": (
        "cannot write `nowhere/run.npz`: there is no folder `nowhere`; create it first"
    ),
    "jj.save(run, '.')": "cannot write `.`: it is a folder; pass the name of a file in it",
    "jj.save(run, 3.5)": "`path` is a float, expected the name of a file",
    "jj.save(b, 'b.npz')": "`save` was given a Bead, expected a `Trajectory` from `jj.simulate`",
    "jj.save(lanes.lanes, 'lanes.npz')": (
        "`save` takes one motion, but was given a batch of shape (2,); for one batch axis, save"
        " `jj.Rollout(batch)`"
    ),
    "jj.animate(lanes, 'run.gif')": (
        "`animate` was given a Rollout, expected one motion; for a rollout pass one "
        "lane: jj.animate(rollout.lane(0), 'lane-0.gif')"
    ),
    "jj.animate(run, 'run.mp4')": "cannot write `run.mp4`: an animation is a .gif file",
    "jj.animate(run, 'run.png', view='top')": (
        "`view` is `top`, expected one of `above`, `side`, `space`, or elevation and azimuth in degrees"
    ),
    "jj.animate(run, 'run.gif', frames=0)": "`frames` is 0, expected a whole number of at least 1",
    "jj.plot(run, 'x', path='run.xyz')": (
        "cannot write `run.xyz`: a plot is a .png, .svg or .pdf file; matplotlib cannot write `xyz`"
    ),
    "jj.plot(run, 'x', path='nowhere/x.png')": (
        "cannot write `nowhere/x.png`: there is no folder `nowhere`; create it first"
    ),
    "jj.plot(run, 'z')": (
        "UnknownNameError",
        "`z` cannot be plotted; valid names: `x`, `y`, `x_rate`, `y_rate`, `energy`",
    ),
    "jj.plot(b, 'x')": "`plot` was given a Bead, expected a motion from `jj.simulate` or a rollout",
    "read_bicycle('nowhere.txt')": (
        "nowhere.txt: cannot be read (No such file or directory); pass the path of a bicycle parameter file"
    ),
    "read_bicycle('.')": ".: cannot be read",
    "read_bicycle('empty.npz')": "empty.npz: the file is empty. Expected lines `name = value`",
    "read_bicycle('run.npz')": "run.npz: not UTF-8 text",
    "read_bicycle(bicycle('wheel = 1\\n'))": "unknown parameter `wheel`; valid names",
    "read_bicycle(bicycle(w='long'))": "value of `w` is `long`, expected a number",
    "read_bicycle(bicycle(w='1.0+/-nan'))": "sigma of `w` is `nan`, expected a finite number",
    "read_bicycle(bicycle(rF='-0.3'))": "degenerate bicycle: `rF`",
}

ANALYSIS: dict[str, Case] = {
    "jj.report(Bead)": "`scene` is the class `Bead`",
    "jj.verify(Bead, {})": "`scene` is the class `Bead`",
    "jj.verify(b, 3.0)": "`state` is a float, expected a State",
    "jj.verify(b, {'z': 1.0})": "scene `Bead` has no coordinate or speed `z`",
    "jj.verify(b, {}, inputs={'force': 1.0})": "`Bead` has no input `force`; valid names: `push`.",
    "jj.verify(b, {}, seed='x')": "`seed` is 'x', expected a whole number that is not negative",
    "jj.linearize(Bead, {})": "`scene` is the class `Bead`",
    "jj.linearize(b, o)": "`state` is an array of shape (3,), expected a State",
    "jj.linearize(sleigh, {}, 'headin')": (
        "`ChaplyginSleigh` has no coordinate `headin` to perturb; did you mean `heading`?"
    ),
    "jj.linearize(b, {}, 3)": "`3` was given, expected names, in one text or in several",
    "jj.linearize(b, {}, ('x', 'x'))": "`coordinates` contains a name twice (x, x); give each once",
    "jj.linearize(sleigh, {}, dependent=('hedding',))": (
        "`ChaplyginSleigh` has no coordinate `hedding` to perturb; did you mean `heading`?"
    ),
    "jj.linearize(sleigh, {}, ('x',), privileged=('heading_rate',))": (
        "`privileged` of `ChaplyginSleigh` names 1 speeds, but the scene has 2"
    ),
    "jj.linearize(sleigh, {}, privileged=('heading_rat', 'x_rate'))": (
        "unknown privileged speed of `ChaplyginSleigh`: `heading_rat`; did you mean"
    ),
    "jj.linearize(chain, None, inputs={'trun': 1.0})": (
        "`TrailerChain` has no input `trun`; did you mean `turn`?"
    ),
    "jj.steady(Bead, {})": "`scene` is the class `Bead`",
    "jj.steady(b, None)": "`guess` is `None`, expected a State or a dictionary of named values",
    "jj.steady(sleigh, {}, held='headin')": (
        "`ChaplyginSleigh` has no `headin` to hold or to move; did you mean `heading`?"
    ),
    "jj.steady(b, {}, moving=('z',))": "`Bead` has no `z` to hold or to move; valid names: `x`, `y`.",
    "jj.steady(b, {}, max_steps=0)": "`max_steps` is 0, expected a whole number of at least 1",
    "jj.build(b, jj.Formulation('full', reduction='kkt')).save('b')": (
        "a model with its own reduction or stabilisation cannot be saved"
    ),
    "jj.steady(b, {}, options={})": "`options` is a dict, expected `jj.Options(...)`",
    "jj.steady(b, {}, rtol=1e-3)": (
        "TypeError",
        "steady() takes no `rtol`: no motion is integrated; `max_steps` bounds the search",
    ),
}

COMMANDS: dict[str, Case] = {
    "shell('sweep status nothing')": ("exit 2", "`nothing` does not exist"),
    "shell('sweep nothing.toml')": (
        "exit 2",
        "nothing.toml: cannot be read (No such file or directory); pass the path of a TOML file",
    ),
    "shell('sweep exprot x.zarr')": ("exit 2", "did you mean `export`"),
    "shell('sweep status')": ("exit 2", "takes one folder"),
    "shell('')": ("exit 2", "the following arguments are required: VERB"),
    "shell('modles')": ("exit 2", "unknown verb `modles`; did you mean `models`"),
    "shell('models extra')": ("exit 2", "unknown model `extra`"),
    "shell('models skate extra')": ("exit 2", "unrecognized arguments: extra"),
    "shell('report')": ("exit 2", "the following arguments are required: model"),
    "shell('report chaplygin-slay')": (
        "exit 2",
        "unknown model `chaplygin-slay`; did you mean `chaplygin-sleigh`",
    ),
    "shell('report pendulum-chain --set links=1.5')": (
        "exit 2",
        "--set links=1.5: `links` of `pendulum-chain` is a count, expected a whole number",
    ),
    "shell('report pendulum-chain --set links=0')": (
        "exit 2",
        "`links` of `PendulumChain` is 0, expected a whole number of particles >= 1",
    ),
    "shell('report pendulum-chain --set link=2')": (
        "exit 2",
        "model `pendulum-chain` has no parameter `link`; did you mean `links`",
    ),
    "shell('verify skate --start z=1')": ("exit 2", "scene `Skate` has no coordinate or speed `z`"),
    "shell('simulate skate --set mas=2')": ("exit 2", "has no parameter `mas`; did you mean `mass`"),
    "shell('simulate skate --set mass')": (
        "exit 2",
        "--set `mass`: the value is ``, expected a number; write NAME=VALUE",
    ),
    "shell('simulate skate --set mass=-1')": (
        "exit 2",
        "parameter `mass` of `Skate` is -1.0, expected a positive number",
    ),
    "shell('simulate skate --set mass=nan')": (
        "exit 2",
        "parameter `mass` of `Skate` is nan, expected finite numbers",
    ),
    "shell('simulate skate --start x=fast')": (
        "exit 2",
        "`x=fast`: the value is `fast`, expected a number; write NAME=VALUE",
    ),
    "shell('simulate skate --start xx=1')": ("exit 2", "has no coordinate or speed `xx`"),
    "shell('simulate skate --t1 later')": ("exit 2", "argument --t1: invalid float value: 'later'"),
    "shell('simulate skate --t1 0')": ("exit 2", "--t1 is 0, expected a finite time in s other than zero"),
    "shell('simulate skate --t1 nan')": (
        "exit 2",
        "--t1 is nan, expected a finite time in s other than zero",
    ),
    "shell('simulate skate --samples 1')": ("exit 2", "--samples is 1, expected at least 2"),
    "shell('simulate skate --samples two')": ("exit 2", "argument --samples: invalid int value: 'two'"),
    "shell('simulate skate --rtol -1')": ("exit 2", "`rtol` is -1, expected a positive finite number"),
    "shell('simulate skate --atol nan')": ("exit 2", "`atol` is nan, expected a positive finite number"),
    "shell('simulate skate --out nowhere/run.npz')": ("exit 2", "there is no folder `nowhere`"),
    "shell('simulate skate --out .')": (
        "exit 2",
        "cannot write `.`: it is a folder; pass the name of a file in it",
    ),
    "shell('simulate skate --animate run.mp4')": (
        "exit 2",
        "cannot write `run.mp4`: an animation is a .gif file",
    ),
    "shell('simulate skate --plot run.xyz')": (
        "exit 2",
        "cannot write `run.xyz`: a plot is a .png, .svg or .pdf file; matplotlib cannot write `xyz`",
    ),
    "shell('bicycle')": ("exit 2", "the following arguments are required: FILE"),
    "shell('bicycle Rigid --samples 0')": ("exit 2", "--samples is 0, expected at least 1"),
    "shell('bicycle Rigid --seed x')": ("exit 2", "argument --seed: invalid int value: 'x'"),
    "shell('bicycle Rigid --out text.npz')": (
        "exit 2",
        "cannot create the folder `text.npz`: File exists; choose another with --out",
    ),
    "shell('bicycle text.npz --no-figures --samples 1 --out refused')": (
        "exit 1",
        "refused: text.npz, line 1: got `no trajectory`, expected `name = value`",
    ),
}

ANSWERS: dict[str, Case] = {
    "answered(loads=lambda self, m: None)": (
        "`loads` of `Described` returned `None`, expected a tuple of loads; write `return"
    ),
    "answered(loads=lambda self, m: {'weight': 1.0})": (
        "`loads` of `Described` returned a dict, expected a tuple of loads"
    ),
    "answered(loads=lambda self, m: (jnp.ones(3),))": (
        "load 0 of `Described` is ... , expected a load, such as jj.point_force"
    ),
    "answered(loads=lambda self, m: (unchecked('forces', {'bead': 1.0}),))": (
        "force of load 0 of `Described` on body `bead` has shape (), expected (3,)"
    ),
    "answered(loads=lambda self, m: (unchecked('generalized', {'x_rate': jnp.ones(2)}),))": (
        "on speed `x_rate` has shape (2,), expected one number"
    ),
    "answered(loads=lambda self, m: (unchecked('potential', jnp.ones(2)),))": (
        "potential of load 0 of `Described` has shape (2,), expected one number"
    ),
    "answered(loads=lambda self, m: (jj.point_force(m['bead'].point(), (1.0, 2.0)),))": (
        "force on a point of `bead` has shape (2,), expected (3,)"
    ),
    "answered(loads=lambda self, m: (jj.point_force(m['bead'].point((1.0, 2.0)), jnp.ones(3)),))": (
        "point of body `bead` has shape (2,), expected (3,)"
    ),
    "answered(loads=lambda self, m: (jj.torque(m, 'bead', 1.0),))": (
        "torque on `bead` has shape (), expected (3,); give three components"
    ),
    "answered(loads=lambda self, m: (jj.gravity(m, 9.81, (0.0, -1.0)),))": (
        "direction of gravity has shape (2,), expected (3,)"
    ),
    "answered(potential=lambda self, pose: pose.q.array)": (
        "the result of `potential` of `Described` has shape (2,), expected one number"
    ),
    "answered(bodies=lambda self, t, q: [jj.Particle(1.0, (0.0, 0.0, 0.0))])": (
        "`bodies` of `Described` returned a list, expected a dictionary by name"
    ),
    "answered(bodies=lambda self, t, q: {})": (
        "`bodies` of `Described` returned no body; return at least one by name"
    ),
    "answered(bodies=lambda self, t, q: {'bead': 3.0})": (
        "body `bead` of `Described` is ... , expected a `jj.Particle` or a `jj.RigidBody`"
    ),
    "answered(bodies=lambda self, t, q: {1: jj.Particle(1.0, (0.0, 0.0, 0.0))})": (
        "`bodies` of `Described` returned a dictionary with the key 1, expected names"
    ),
    "answered(geometric_constraints=lambda self, p: p.q.x - p.q.y)": (
        "`geometric_constraints` of `Described` returned ... , expected a dictionary by name"
    ),
    "answered(geometric_constraints=lambda self, p: {'row': p.q.x > 0})": (
        "constraint `row` of `Described` is of type bool, expected real numbers"
    ),
    "answered(velocity_constraints=lambda self, m: (m.u.x_rate,))": (
        "`velocity_constraints` of `Described` returned a tuple, expected a dictionary"
    ),
    "answered(velocity_constraints=lambda self, m: {'row': None})": (
        "constraint `row` of `Described` is `None`, expected real numbers"
    ),
    "answered(prescribed=lambda self, t: {'x': jnp.stack([t, t])})": (
        "prescribed value of `x` of `Described` has shape (2,), expected one number"
    ),
    "answered(prescribed=lambda self, t: t)": (
        "`prescribed` of `Described` returned ... , expected a dictionary by name"
    ),
    "answered(contacts=lambda self, pose: {'rim': 1.0})": (
        "contact `rim` of `Described` is a float, expected a `jj.disc_contact"
    ),
    "answered(coordinate_rates=lambda self, t, q, u: jnp.ones(3))": (
        "the result of `coordinate_rates` of `Described` has shape (3,), expected (2,); return one rate for"
        " each of x, y"
    ),
    "answered(coordinate_rates=lambda self, t, q, u: None)": (
        "the result of `coordinate_rates` of `Described` is `None`, expected real numbers"
    ),
    "jj.simulate(described(events=lambda self, m: {'out': 1.0 - m.q.array}), {}, t1=0.1)": (
        "event `out` of `Described` has shape (2,), expected one number; return a number, positive while"
    ),
    "jj.accelerations(b, 0.0, o, two)": (
        "`q` of `Bead` has shape (3,), expected (2,); one number for each of x, y; use `jax.vmap`"
    ),
    "jj.accelerations(b, 0.0, two, two, reduction=3)": (
        "`reduction` is an int, expected a name (privileged, qr, svd, kkt"
    ),
    "jj.RigidBody(1.0, 0.4, o, eye)": (
        "inertia of a rigid body has shape (), expected (3, 3); give three principal moments"
    ),
    "jj.RigidBody(1.0, jnp.ones(3), o, eye, jnp.ones(3))": (
        "outline of a rigid body has shape (3,), expected (points, 3)"
    ),
    "jj.RigidBody('a', jnp.ones(3), o, eye)": "mass of a rigid body is the text 'a', expected real numbers",
    "jj.Plane(origin=(0.0, 1.0))": "origin of a plane has shape (2,), expected (3,)",
    "jj.fixed_point((1.0, 2.0))": "position of a fixed point has shape (2,), expected (3,)",
}

CONTACTS: dict[str, Case] = {
    "jj.Plane(normal=(0.0, 0.0, 1.0), tilt=0.1)": "a plane has both a `tilt` and a `normal`",
    "jj.Plane(normal=(0.0, 0.0, 1.0), along=(0.0, 0.0, 3.0))": "`along` of a plane is normal to it",
    "jj.Plane(tilt=(0.1, 0.2))": (
        "tilt of a plane has shape (2,), expected one number; give one angle in rad, or a rotation matrix"
    ),
    "jj.Cylinder(-0.3, (1.0, 0.0, 0.0), side='inside')": (
        "radius of a cylinder is -0.3, expected positive numbers"
    ),
    "jj.Sphere(0.3, side='within')": "side `within` is unknown; expected `inside` or `outside`",
    "jj.Surface(1.0)": "a surface is given by a float, expected a function of numbers; write lambda x, y, z",
    "jj.HeightMap('hill')": "a height map is given by the text 'hill', expected a function of numbers",
    "jj.HeightMap(lambda x, y: jnp.stack([x, y])).plane_at((0.0, 0.0, 0.0))": (
        "h(x, y) of a height map has shape (2,), expected one number"
    ),
    "jj.ball_contact(body, -0.3)": "radius of the contact of `bead` is -0.3, expected positive numbers",
    "jj.ellipsoid_contact(body, (0.1, 0.0, 0.2))": (
        "semi-axes of the contact of `bead` is [0.1, 0.0, 0.2], expected positive numbers"
    ),
    "jj.Contact(body, (0.0, 0.0, 0.0), height='line')": "contact height `line` is unknown",
    "jj.Contact(body, (0.0, 0.0))": "point of the contact of `bead` has shape (2,), expected (3,)",
    "jj.Contact(3.0, (0.0, 0.0, 0.0))": "the body of a contact is a float, expected the pose of a body",
    "jj.Contact(body, (0.0, 0.0, 0.0), jj.Sphere(1.0, side='inside'))": (
        "expected a `jj.Plane(...)`, ... write ground=..."
    ),
    "jj.Contact(body, (0.0, 0.0, 0.0), shape='ball')": (
        "`shape` of the contact of `bead` is the text 'ball', ... state the body's look in `visuals`"
    ),
    "jj.Contact(body, (0.0, 0.0, 0.0), ground=0.0)": (
        "`ground` of the contact of `bead` is a float, expected a `jj.Plane"
    ),
}

LOOKS: dict[str, Case] = {
    "jj.Visual.ball(-1.0)": "radius of a ball is -1.0, expected positive numbers",
    "jj.Visual.ball(1.0, colour='red')": 'expected six hexadecimal digits, such as "#1f77b4"',
    "jj.Visual.ball(1.0, opacity=2.0)": "opacity of a ellipsoid is 2.0",
    "jj.Visual.line((0.0, 0.0, 0.0))": "has 1 points, expected at least two",
    "jj.Visual.wheel(1.0, axis='w')": "body axis `w` is unknown",
    "jj.Visual.mesh(np.zeros((4, 2)), [(0, 1, 2)])": "expected (points, 3)",
    "jj.Visual.mesh(np.zeros((4, 3)), [(0, 1, 4)])": "vertex numbers each, from 0 to 3",
}

TABLE: dict[str, Case] = (
    BODIES
    | PARAMETERS
    | NAMES
    | PARTS
    | ROWS
    | STATES
    | MOTIONS
    | BATCHES
    | FILES
    | ANALYSIS
    | COMMANDS
    | ANSWERS
    | CONTACTS
    | LOOKS
)
