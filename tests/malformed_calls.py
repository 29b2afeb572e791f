"""Calls of analyses, views, files and solvers that cannot be served, as one table: see `malformed_inputs`."""

PRELUDE = '''
import pathlib
import diffrax, jax, jax.numpy as jnp, numpy as np
import jourdain_jax as jj
from jourdain_jax.cli.sweep_verbs import described_study
from long_runs_scenes import ContactOscillator
from test_plausible_bodies import BallOnPlate, OnLift, OnSledge
from test_possible_inertia import Turning
from small_scenes import Bead, Cart, DrivenPendulum, Oscillator, OnPlane

model, Sleigh = jj.models.model, jj.models.ChaplyginSleigh
TS, START = np.array([0.5, 1.0]), {"x_rate": 0.6, "heading_rate": 0.9}
sleigh, disc, skate, oscillator = (
    Sleigh(mass=1.0),
    jj.models.TiltingDisc(),
    jj.models.Skate(),
    ContactOscillator(),
)
data = jj.Experiment(TS, {"x": np.array([0.3, 0.5])}, 0.01, start=START)
moved = jj.simulate(sleigh, START, ts=TS)
study = jj.Study(sleigh, vary={"offset": [0.2, 0.3]})
calls = {
    "simulate": lambda **options: jj.simulate(sleigh, START, ts=TS, **options),
    "rollout": lambda **options: jj.rollout(sleigh, {"x_rate": np.array([0.6])}, ts=TS, **options),
    "fit": lambda **options: jj.fit(sleigh, data, ("offset",), **options),
    "fit_batch": lambda **options: jj.fit_batch(sleigh, data, ("offset",), **options),
    "log_likelihood": lambda **options: jj.identification.log_likelihood(sleigh, data, **options),
    "log_density": lambda **options: jj.identification.log_density(sleigh, data, ("offset",), **options),
    "planned_information": lambda **options: jj.identification.planned_information(
        sleigh, data, ("offset",), **options
    ),
    "filtered_log_likelihood": lambda **options: jj.identification.filtered_log_likelihood(
        sleigh, data, process_noise={}, **options
    ),
    "Study.run": lambda **options: study.run("nowhere", **options),
}


class Stopped(Oscillator):
    """An oscillator that a buffer stops at its centre."""

    def events(self, motion):
        return {"buffer": motion.q.x, "far": 3.0 - motion.q.x}


def stopped(events={"buffer": (0.9, 0.003)}, values=None, **more):
    """A run of which no more than its event is known, unless values are given."""
    ts = np.array([0.5]) if values is None else 0.1 * np.arange(1.0, len(values) + 1.0)
    return jj.Experiment(
        ts, {} if values is None else {"x": values}, 0.005, start={"x": 0.3}, t0=0.0, events=events, **more
    )


def event(*given, **options):
    return jj.fit(Stopped(), stopped(**options), ("mass",))


def tied(function):
    return jj.fit(sleigh, data, free={"offset": None, "inertia": function})


def pieces(count, **shooting):
    ts = np.linspace(0.0, 0.5, count)
    return jj.fit(
        Cart(),
        jj.Experiment(ts, {"x": ts}, 0.1, start={"x": 0.0}),
        "mass",
        shooting=jj.identification.MultipleShooting(**shooting),
    )


def planned(**changes):
    run = jj.Experiment(TS, {"x": TS}, **({"sigma": 0.01, "start": {"x": 0.3}} | changes))
    return jj.identification.planned_information(Cart(damping=0.0), run, ("mass",))


def cell(scene, name):
    """What a load cell under this contact tells."""
    shown = jj.Experiment(
        TS, {"plate": np.ones((2, 3))}, 1.0, start={}, sensors={"plate": jj.identification.LoadCell(name)}
    )
    return jj.fit(scene, shown, ("mass",))


def gradients(parameters, **more):
    return jj.Study(sleigh, **more).mean_gradients(
        parameters=parameters, t1=0.1, outputs={"x": jj.studies.End("x")}
    )


def described(**members):
    """The bead with some members replaced."""
    return type("Described", (Bead,), members)()


class Bare(jj.Scene):
    coordinates = jj.coordinates("x")


class Random(OnPlane):
    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=motion.q.x * jax.random.normal(jax.random.key(0))),)


def looking(visuals):
    """A sleigh that is shown with these looks."""
    kind = type("Looking", (Sleigh,), {"visuals": lambda self, pose: visuals()})
    return jj.show(jj.simulate(kind(), START, ts=TS))


class Body(Turning):
    """A turning body whose inertia is made of its moments in some other way."""

    first: jnp.ndarray = jj.parameter(0.01, unit="kg m^2")
    second: jnp.ndarray = jj.parameter(0.02, unit="kg m^2")


def crossing(i, j):
    """Ones at two places of a symmetric matrix."""
    return jnp.zeros((3, 3)).at[i, j].set(1.0).at[j, i].set(1.0)


def inertia(made=lambda s: jnp.diag(s.moments), free={}, moments=(0.5, 0.7, 0.4)):
    scene = type("Turning", (Body,), {"inertia": made})(moments=jnp.array(moments))
    return jj.fit(scene, jj.Experiment(TS, {"yaw": TS}, 0.1, start={}), {"body": possible} | free)


possible = jj.identification.possible_inertia()


def described_file(**changes):
    return described_study(
        {"model": "tilting-disc", "samples": 8, "vary": {"radius": {"normal": [0.5, 0.01]}}} | changes
    )


def file(save, load):
    """A file of one kind, read as another."""
    jj.save(save(), "kept.npz")
    try:
        return load("kept.npz")
    finally:
        pathlib.Path("kept.npz").unlink()
'''
KEYWORD = "{}() got an unexpected keyword argument 'rtoll'; did you mean `rtol`"
CALLED = [
    "simulate",
    "rollout",
    "fit",
    "fit_batch",
    "log_likelihood",
    "log_density",
    "planned_information",
    "filtered_log_likelihood",
    "Study.run",
]
WENT = ["saveat", "stepsize_controller", "dt0", "adjoint"]

OPTIONS = {f"calls['{name}'](rtoll=1e-6)": ("TypeError", KEYWORD.format(name)) for name in CALLED}
OPTIONS |= {
    f"calls['{name}']({option}=None)": ("TypeError", f"`{option}` is no longer an option: ")
    for name in CALLED
    for option in WENT
}
OPTIONS |= {
    "calls['fit'](ts=TS)": ("TypeError", "each `Experiment` states start, times and inputs"),
    "calls['fit'](retry=True)": ("TypeError", "by one compiled method"),
    "calls['log_likelihood'](events=False)": ("TypeError", "ends with its last sample"),
    "calls['Study.run'](parameters=None)": ("TypeError", "`outputs` and `save` choose the stored results"),
    "calls['simulate'](backend='native', solver=diffrax.Heun())": (
        "'native' cannot integrate `ChaplyginSleigh`: the solver is"
    ),
    "calls['rollout'](backend='native', solver=diffrax.Heun())": (
        "'native' cannot integrate `ChaplyginSleigh`: the solver is"
    ),
    "calls['simulate'](backend='native', formulation=jj.Formulation(reduction='kkt'))": (
        "'native' cannot integrate `ChaplyginSleigh`: a formulation with its own reduction"
    ),
    "calls['rollout'](backend='native', formulation=jj.Formulation(reduction='kkt'))": (
        "'native' cannot integrate `ChaplyginSleigh`: a formulation with its own reduction"
    ),
    "calls['simulate'](backend='xla', formulation=jj.Formulation(reduction='kkt'))": (
        "'xla' cannot integrate `ChaplyginSleigh`: a formulation with its own reduction"
    ),
    "calls['rollout'](backend='xla', formulation=jj.Formulation(reduction='kkt'))": (
        "'xla' cannot integrate `ChaplyginSleigh`: a formulation with its own reduction"
    ),
    "calls['simulate'](backend='nativ')": "unknown backend `nativ` ... native",
    "calls['rollout'](backend='nativ')": "unknown backend `nativ` ... native",
    "jax.jit(lambda rtol: calls['simulate'](rtol=rtol).q_end)(1e-8)": (
        "`rtol` is traced, ... pass a `solver`"
    ),
}

SOLVERS = {
    "jj.ImplicitMidpoint(step=0.0)": (
        "`step` of `ImplicitMidpoint` is 0, expected a positive finite length in s"
    ),
    "jj.simulate(oscillator, max_step=0.1, solver=jj.ImplicitMidpoint(step=0.2))": (
        "; set its step with jj.ImplicitMidpoint(step="
    ),
    "jj.DiscreteLagrangeDAlembert('midpiont', step=0.1)": (
        "unknown rule `midpiont` of `DiscreteLagrangeDAlembert`; did you mean `midpoint`"
    ),
    (
        "jj.simulate(oscillator, solver=jj.DiscreteLagrangeDAlembert(step=0.1), "
        "formulation=jj.Formulation('minimal'))"
    ): ("leave the `state` of its `Formulation`"),
    "jj.simulate(model('free-rigid-body'), solver=jj.DiscreteLagrangeDAlembert(step=0.1))": (
        "does not apply to `FreeRigidBody`: its speeds are quasi-velocities or angular velocities ... ; use"
        " solver=jj.ImplicitMidpoint(step="
    ),
    "jj.simulate(model('isokinetic-particle'), solver=jj.DiscreteLagrangeDAlembert(step=0.1))": (
        "its constraints are nonlinear in the speeds"
    ),
    "jj.simulate(DrivenPendulum(), solver=jj.DiscreteGradient(step=0.1))": (
        "does not apply to `DrivenPendulum`: its T + V is not constant"
    ),
    "jj.simulate(model('double-pendulum-rods'), solver=jj.DiscreteGradient(step=0.1))": (
        "its geometric constraints would need a projection"
    ),
    "jj.simulate(model('skate'), solver=jj.DiscreteGradient(step=0.1))": (
        "needs the minimal state (`jj.Formulation('minimal')` uses the independent"
    ),
}

FITS = {
    "tied(lambda scene: jnp.array([1.0, 2.0]) * scene.mass)": (
        "`inertia` returns an array of shape (2,), expected ()"
    ),
    "tied(lambda scene: -scene.mass)": (
        "at the first guess the function in `free` of `inertia` gives a value that is not allowed"
    ),
    "tied(lambda scene: scene.mass / (scene.mass - 1.0))": "not allowed: ... `inertia`",
    "tied(lambda scene: 'heavy')": "returns ... heavy ... , expected a number",
    "jj.fit(sleigh, data, free={'inertia': lambda scene: scene.mass})": "nothing is free",
    "event(events={'bufer': (0.9, 0.003)})": (
        "names `bufer`, which is not an event of the scene; did you mean `buffer`"
    ),
    "event(events={'buffer': (0.9, 0.003), 'far': (1.0, 0.003)})": (
        "`events` names `buffer`, `far`, but a motion stops at its first"
    ),
    "event(events={'buffer': 0.9})": "event `buffer` was given 0.9, expected (time, sigma)",
    "event(events={'buffer': (0.0, 0.003)})": (
        "the time of event `buffer` is 0.0 s, expected a time after the start"
    ),
    "event(events={'buffer': (0.9, 0.0)})": "sigma of channel `buffer` must be above zero",
    "event(events={'x': (0.9, 0.003)}, values=np.ones(8))": "`x` is both a channel and an event",
    "event(sensors={'buffer': 'x'})": "`buffer` is an event, whose time has no sensor",
    (
        "jj.fit(Stopped(), stopped(values=np.ones(8)), ('mass',), "
        "shooting=jj.identification.MultipleShooting(pieces=2))"
    ): ("run 0 has a measured time of its event `buffer`, which `shooting` does not use"),
    (
        "jj.identification.filtered_log_likelihood(Stopped(), stopped(values=np.ones(8)), "
        "process_noise={'x_rate': 0.1})"
    ): ("run 0 gives the time of its event `buffer`, which the filter does not use"),
    "jj.identification.MultipleShooting()": "expects either `pieces`",
    "jj.identification.MultipleShooting(pieces=4, duration=1.0)": "expects either `pieces`",
    "jj.identification.MultipleShooting(pieces=1)": "two or more",
    "jj.identification.MultipleShooting(duration=0.0)": "positive finite time",
    "jj.identification.MultipleShooting(duration=np.nan)": "positive finite time",
    "pieces(11, pieces=20)": "run 0 has 11 samples, too few for 20 pieces",
    "pieces(11, duration=2.0)": "one piece only",
    "planned(sigma=None)": "sigma of channel `x` is None",
    "planned(correlation_time=0.1)": "has a correlation time",
    "planned().log_det('mas')": ("KeyError", "`mas` is not among the unknowns"),
    "cell(disc, 'rin')": (
        "the load cell `plate` of run 0 of `TiltingDisc` is under contact `rin`, which does not exist; did"
        " you mean `rim`"
    ),
    "cell(jj.models.TwoWheelAxleRedundant(), 'wheel1')": (
        "is under contact `wheel1`, whose force is not determined"
    ),
    "jj.identification.LoadCell(3)": "`contact` of `LoadCell` is an int",
    "jj.steady(disc, {'lean': 0.3}, held=('leen',))": "did you mean `lean`",
    "jj.steady(disc, {'lean': 0.3}, moving=('spinn',))": "did you mean `spin`",
    "gradients(('ofset',), start={'x_rate': jj.studies.Normal(0.5, 0.1)}, samples=8)": (
        "`ofset` is not a parameter of the scene; ... `offset`"
    ),
    "gradients(('offset',), vary={'offset': jj.studies.Normal(0.25, 0.01)}, samples=8)": (
        "`offset` varies over the samples"
    ),
    "jj.Spline([0.0, 2.0, 1.0], [0.0, 1.0, 2.0])": "`Spline`",
    "jj.Spline([0.0, 1.0], [0.0, np.nan])": "`Spline`",
    "jj.Spline([0.0, 1.0], [0.0, 1.0, 2.0])": "`Spline`",
    "jj.Spline(0.0, 1.0)": "`Spline`",
    "jj.Spline(['a'], [0])": "`Spline`",
    "jj.quaternion_to_matrix([0.0, 0.0, 0.0, 0.0])": "quaternion is (0, 0, 0, 0), which is not an attitude",
    "jj.start(jj.models.FreeRigidBody(), attitude=jnp.zeros(4))": (
        "violates constraint `norm of quaternion 1`"
    ),
    "jj.start(disc, lean=0.3, spin_rate=-3.0, x_rate=7.0, yaw_rate=0.1)": "violates constraint",
}

INERTIAS = {
    "jj.fit(Turning(), jj.Experiment(TS, {'yaw': TS}, 0.1, start={}), {'bodi': possible})": (
        "`bodi`, which is not a body of `Turning`; did you mean `body`"
    ),
    (
        "jj.fit(model('double-pendulum-rods'), jj.Experiment(TS, {'x1': TS}, 0.1, start={}), "
        "{'first': possible})"
    ): ("is a particle; name a rigid body"),
    "jj.fit(disc, jj.Experiment(TS, {'lean': TS}, 0.1, start={}), {'disc': possible})": (
        "entry 11 of its inertia is made of `mass`, `radius`"
    ),
    "inertia(free={'moments': None})": (
        "`free` has `moments` and the possible inertia of `body`, which determines `moments`"
    ),
    "inertia(free={'moments': lambda scene: scene.moments})": (
        "a function for `moments` and the possible inertia"
    ),
    "inertia(moments=(0.1, 0.1, 0.3))": (
        "no body of nonzero thickness has the inertia of body ... 0.1, 0.1, 0.3 kg m"
    ),
    "inertia(lambda s: jnp.array([0.0, 0.0, 1.0]) * s.moments[0])": (
        "entry 11 of its inertia, 0 kg m ... , is not a parameter; give each parameter its own"
    ),
    "inertia(lambda s: jnp.array([1.0, 1.5, 1.0]) * s.moments[0])": (
        "moments about axes 1 and 2 are different multiples of `moments`"
    ),
    "inertia(lambda s: s.moments**2)": (
        "entry 11 of its inertia is made of `moments`, expected one parameter times a constant"
    ),
    "inertia(lambda s: jnp.diag(s.moments) + s.first * crossing(0, 1) + s.second * crossing(0, 2))": (
        "it has 2 products of inertia and 3 different moments, expected"
    ),
    "inertia(lambda s: jnp.diag(s.moments) + s.moments[0] * crossing(0, 1))": (
        "one parameter serves as a moment and a product"
    ),
}

IMPOSSIBLE = {
    "jj.structure_of(BallOnPlate(rise=0.3))": (
        "the plane of contact `plate` of `BallOnPlate` moves along its normal at 0.3 m/s by `origin` and"
        " `tilt`, but at 0 m/s by `velocity`"
    ),
    "jj.structure_of(BallOnPlate(stated_rise=0.3))": (
        "at 0 m/s by `origin` and `tilt`, but at 0.3 m/s by `velocity` and `angular_velocity`; state the"
        " motion in both"
    ),
    "jj.structure_of(BallOnPlate(turn=0.2))": (
        "the plane of contact `plate` ... angular_velocity = (0, d tilt/dt, 0)"
    ),
    "jj.structure_of(BallOnPlate(turn=0.2, stated_turn=-0.2))": "the plane of contact `plate`",
    "jj.structure_of(OnSledge())": (
        "the ground of contact `back` of `OnSledge` moves with another body, but its `velocity` and"
    ),
    "jj.structure_of(OnSledge(lambda pose, back: jj.HeightMap(lambda x, y: 0.05 + 0.01 * (x - back[0]))))": (
        "moves with another body, but its `velocity` and"
    ),
    (
        "jj.structure_of(OnSledge(lambda pose, back: jj.Cylinder(3.0, (0.0, 1.0, 0.0), side='outside', "
        "origin=back - jnp.array([0.0, 0.0, 3.0]))))"
    ): ("moves with another body, but its `velocity` and"),
    "jj.structure_of(OnLift(lambda q, up: jj.Plane(up)))": (
        "the plane of contact `back` of `OnLift` moves along its normal ... if coordinates move it, omit the"
        " contact"
    ),
    "jj.structure_of(OnLift(lambda q, up: jj.Plane(tilt=q.rise)))": (
        "the plane of contact `back` of `OnLift` moves along its normal"
    ),
}

PLOTTED = {
    "jj.plot([moved] * 2, 'heading', units={'heading': 'degrees'})": (
        "`degrees` is not a known unit of the coordinate `heading` ... did you mean `deg`"
    ),
    "jj.plot(moved, 'heading', units={'heading': 'deg/s'})": (
        "`deg/s` is not a known unit of the coordinate `heading`"
    ),
    "jj.plot(moved, 'heading', units={'heading_rate': 'deg'})": (
        "`deg` is not a known unit of the speed `heading_rate`"
    ),
    "jj.plot(moved, 'heading', units={'heding': 'deg'})": (
        "KeyError",
        "`units` names `heding` ... did you mean `heading`",
    ),
    "jj.plot(moved, 'heading', units='deg')": (
        '`units` is ... , expected a dictionary from names to units, such as {"lean": "deg"}'
    ),
    "jj.plot([moved] * 2, 'heading', labels='one')": (
        "`labels` is 'one', expected a list of 2 labels, one per motion"
    ),
    "jj.plot([moved] * 2, 'heading', labels=['one'])": "expected a list of 2 labels, one per motion",
    "jj.plot(moved, 'heading', bands=0.5)": "`bands` is 0.5, expected fractions between 0 and 1",
    "jj.plot(moved, 'heading', bands=(50,))": "`bands` is (50,), expected fractions",
    "jj.plot(moved, 'heading', axes=[None, None])": (
        "`axes` holds 2 axes for 1 names; pass one for each of heading"
    ),
    "jj.plot([moved, sleigh], 'x')": "`plot` was given ... in place 1, expected a motion",
    "jj.plot([], 'x')": "`plot` was given an empty list",
    "jj.show(sleigh)": "`show` was given ... expected a motion from `jj.simulate`",
    "jj.show(moved, 'ride.gif')": "a 3D view is a .html file; for a .gif use `jj.animate`",
    "jj.show(moved, 'missing/ride.html')": "there is no folder",
    "jj.show(moved, colours={'sleig': '#ff0000'})": (
        "`colours` names `sleig`, which is not a body; did you mean `sleigh`"
    ),
    "jj.show(moved, view=(1.0, 2.0, 3.0))": "expected elevation and azimuth",
    "looking(lambda: {'sleig': jj.Visual.ball(0.1)})": "names `sleig`, which is neither a body",
    "looking(lambda: {'sleigh': 0.1})": "gives ... for `sleigh`, expected shapes",
    "moved['headin']": (
        "KeyError",
        "a trajectory of `ChaplyginSleigh` has no `headin`; did you mean `heading`? Valid names:",
    ),
    "moved.constraint_forces().forces_on('slegh')": ("KeyError", "did you mean `sleigh`"),
    "moved.point('sleigh', (1.0, 2.0))": (
        "point of body `sleigh` has shape (2,), expected (3,); pass three components in its body frame, m"
    ),
    "moved.point('slegh')": (
        "KeyError",
        "no body `slegh` in this scene; did you mean `sleigh`? Valid names: `sleigh`.",
    ),
    (
        "jj.simulate(described(invariants=lambda self, m: {'momentum': m['bead'].velocity}), {}, "
        "t1=0.1).invariants()"
    ): (
        "invariant `momentum` of `Described` has shape (3,), expected one number; give every component its"
        " own name"
    ),
    "file(lambda: moved, lambda path: jj.load_rollout(path, Sleigh))": (
        "holds a trajectory, expected a rollout; read it with `jj.load_trajectory(path, scene)`"
    ),
    "file(lambda: calls['rollout'](), lambda path: jj.load_trajectory(path, Sleigh))": (
        "holds a rollout, expected a trajectory; read it with `jj.load_rollout(path, scene)`"
    ),
    "file(lambda: calls['rollout'](), lambda path: jj.load_rollout(path, jj.models.Skate))": (
        "holds a rollout of `ChaplyginSleigh`, expected `Skate`"
    ),
}

SWEEPS = {
    "described_file(modell='x')": "did you mean `model`",
    "described_file(model='disk')": "unknown model `disk`",
    "described_file(vary={'radius': {'gauss': [1.0, 2.0]}})": "expected a distribution",
    "described_file(vary={'radius': {'normal': [1.0]}})": "1 numbers, expected 2",
    "described_file(vary={'radius': [1.0]})": "write, for example",
    "described_file(outputs={'x': {'ende': 'lean'}})": "output `x`",
    "described_file(samples=0)": "`samples` is 0",
    "described_file(sampler='sobol2')": "did you mean `sobol`",
    "described_file(set=3)": "`set` is an int, expected a table",
    "described_file(options={'processes': 2})": "`processes` is not an entry of",
    "described_file(options={'outputs': {}})": "`outputs` is not an entry of",
    "described_file(t1=1.0, options={'t1': 2.0})": "`t1` is not an entry of",
}

CLASSES = {
    "described(domain={'xx': (0.0, 1.0)})": (
        "`domain` of `Described` names `xx`, which is not a coordinate or speed; did you mean `x`"
    ),
    "described(domain={'x': (1.0, -1.0)})": (
        "`domain` of `Described` gives (1.0, -1.0) for `x`, expected two finite numbers (low, high) with low"
        " <= high"
    ),
    "described(domain={'x': 1.0})": "gives 1.0 for `x`, expected two finite numbers",
    "described(domain={'x': (0.0, jnp.inf)})": "for `x`, expected two finite numbers",
    "described(domain=('x', 0.0, 1.0))": "`domain` of `Described` is a tuple, expected a dictionary",
    "described(example={'x_rat': 1.0})": (
        "`example` of `Described` names `x_rat`, which is not a coordinate or speed; did you mean `x_rate`"
    ),
    "described(speeds=jj.speeds('a b c'))": (
        "`Described` defines speeds (a, b, c) but not the rates of its coordinates; define "
        "`coordinate_rates(self, t, q, u)`"
    ),
    "described(speeds='a b')": (
        "`speeds` of `Described` is the text 'a b', expected names; write speeds = jj.speeds('a b c')"
    ),
    "described(inputs=('drive',))": (
        "`inputs` of `Described` is a tuple, expected names; write inputs = jj.inputs"
    ),
    "described(speeds=jj.speeds('x w'), coordinate_rates=lambda self, t, q, u: u.array)": (
        "has a coordinate and a speed named `x`; rename one of them"
    ),
    "described(mass=5.0)": (
        "`Described` sets `mass`, a field of a base class, without an annotation, which has no effect"
    ),
    "described(priviledged=('x_rate',))": (
        "`Described` has an attribute `priviledged`, which nothing calls; did you mean `privileged`?"
    ),
    "described(exemple=property(lambda self: {}))": "has a method `exemple`, ... did you mean `example`?",
    "jj.simulate(Bare(), {}, t1=1.0)": ("NotImplementedError", "define `bodies(self, t, q)`"),
    "jj.simulate(Random(), {'x': 1.0}, t1=1.0)": "draws random numbers",
    (
        "jj.accelerations(described(geometric_constraints=lambda self, "
        "pose: {'row': pose.q.x - pose.q.y}, velocity_constraints=lambda self, "
        "motion: {'row': motion.u.x_rate}), 0.0, jnp.zeros(2), jnp.zeros(2))"
    ): ("constraint name `row` of `Described` is used twice"),
}

TABLE = OPTIONS | SOLVERS | FITS | INERTIAS | IMPOSSIBLE | PLOTTED | SWEEPS | CLASSES
