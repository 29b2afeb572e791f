"""Contacts with friction: slip, sticking, flight and impacts, against closed forms and independent
integrations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import with_value
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from result_codes import AMBIGUOUS, SUCCESS

import jourdain_jax as jj
from jourdain_jax.bicycle import measured_bicycle, shipped_bicycles

G = 9.81


class Heavy(jj.Scene):
    """What weighs and has no other load."""

    def loads(self, motion):
        return jj.gravity(motion, getattr(self, "g", G))


class Ball(Heavy):
    """A ball above a plane."""

    mass: float = jj.parameter(0.17, positive=True)
    radius: float = jj.parameter(0.0285, positive=True)
    friction: float = jj.parameter(0.2)
    bounce: float = jj.parameter(0.0)
    g: float = jj.parameter(G)
    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def bodies(self, t, q):
        return {
            "ball": jj.RigidBody.ball(
                self.mass,
                self.radius,
                position=[q.x, q.y, q.z],
                orientation=jj.quaternion_to_matrix(q.attitude),
            )
        }

    def contacts(self, pose):
        return {
            "cloth": jj.ball_contact(
                pose["ball"], self.radius, height="row", friction=self.friction, restitution=self.bounce
            )
        }


SLIDING = {"z": 0.0285, "x_rate": 3.0, "y_rate": 0.4, "attitude_omega": (5.0, -12.0, 20.0)}
FINE = {"rtol": 1e-12, "atol": 1e-12}


def test_a_ball_slides_and_then_rolls():
    """w0 = v + omega x (-R n);   t = 2 |w0|/(7 mu g), speeds then v - 2/7 w0."""
    motion = jj.simulate(Ball(), SLIDING, ts=[0.2, 1.0, 2.0], **FINE)
    assert_allclose(motion.phases.ts[0], 0.493045748408300, rtol=1e-11)
    assert_allclose([motion["x_rate"][1], motion["y_rate"][1]], [2.04514285714286, 0.245], rtol=1e-11)
    assert_allclose([motion["x"][2], motion["y"][2]], [4.32567984159722, 0.528211045501643], rtol=1e-11)
    assert motion.phase("cloth").tolist() == [2, 1, 1]
    assert_allclose(motion.energies().balance, motion.energies().balance[0], rtol=1e-11)
    forces = motion.contact_forces()["cloth"]
    assert_allclose(forces.normal, 0.17 * G, rtol=1e-10)
    assert_allclose(forces.friction_needed, [0.2, 0.0, 0.0], atol=1e-8)
    assert "cloth: rolls" in str(motion.phases)


def test_derivatives_of_slip():
    def end(numbers):
        friction, speed, radius = numbers
        start = SLIDING | {"z": radius, "x_rate": speed}
        return jj.simulate(Ball(friction=friction, radius=radius), start, ts=[2.0], **FINE)["x"][-1]

    numbers = jnp.array([0.2, 3.0, 0.0285])
    first = [-1.17697063655753, 1.56763330222260, -5.13270016244590]
    assert_allclose(jax.jit(jax.grad(end))(numbers), first, rtol=1e-9)


def test_derivatives_across_slip():
    """A ball thrown aside of its slip: place, speed and end of slip by the closed form; derivatives of both
    orders by friction.
    """
    speed, spin, radius, T = jnp.array([8.0, -0.4]), 15.0, 0.108, 3.0

    def right(friction):
        slip = speed + jnp.array([0.0, radius * spin])
        end = 2 * jnp.linalg.norm(slip) / (7 * friction * G)
        rolling = speed - 2 / 7 * slip
        return jnp.concatenate(
            [
                speed * end - friction * G * slip / jnp.linalg.norm(slip) * end**2 / 2 + rolling * (T - end),
                rolling,
                end[None],
            ]
        )

    def found(friction):
        start = {"z": radius, "x_rate": speed[0], "y_rate": speed[1], "attitude_omega_x": spin}
        motion = jj.simulate(Ball(mass=6.8, radius=radius, friction=friction), start, ts=[T], **FINE)
        return jnp.stack(
            [*(motion[name][-1] for name in ("x", "y", "x_rate", "y_rate")), motion.phases.ts[0]]
        )

    (second, first), (second_right, first_right) = (
        with_value(jax.jacfwd, jax.jacfwd(f))(0.12) for f in (found, right)
    )
    assert_allclose(first, first_right, rtol=1e-9, atol=5e-9)
    assert_allclose(second, second_right, rtol=1e-8, atol=5e-6)  # of up to 312


class PulledBlock(Ball):
    """A block on a floor under a force of 3 (1 + t) N that turns at 2 rad/s."""

    coordinates = jj.coordinates("x y z")

    def bodies(self, t, q):
        return {"ball": jj.RigidBody(self.mass, jnp.eye(3), [q.x, q.y, q.z], jnp.eye(3))}

    def loads(self, motion):
        t = motion.t
        force = 3 * (1 + t) * jnp.stack([jnp.cos(2 * t), jnp.sin(2 * t), 0.0 * t])
        return jj.gravity(motion, self.g), jj.Load(forces={"ball": force})


def test_slip_that_begins_under_a_force_that_turns():
    """Reference: integration by Radau from small times on (`|f|` reaches friction at t = 0). A tolerance says
    how slow a slip may turn as if it were faster, so loose ones need few steps.
    """
    scene = PulledBlock(mass=1.0, friction=0.3, g=10.0)
    for tolerance, most, off in ((1e-10, 600, 6e-9), (1e-6, 100, 1e-6), (1e-4, 40, 1e-4)):
        motion = jj.simulate(scene, {"z": 0.0285}, t0=-0.1, ts=[0.5], rtol=tolerance, atol=tolerance)
        x, y, vx, vy = (motion[name][0] for name in ("x", "y", "x_rate", "y_rate"))
        found = [x, y, jnp.hypot(vx, vy), jnp.arctan2(vy, vx)]
        assert_allclose(found, [0.04826763, 0.03778878, 0.37065575, 0.86840719], atol=off, rtol=0)
        assert motion.accepted + motion.rejected <= most


def test_bounces_and_rest():
    """t_n = t_0 (1 + 2 (e + ... + e^n)) with t_0 = sqrt(2 h/g); at rest after t_0 (1 + e)/(1 - e)."""

    def tenth(numbers):
        bounce, height = numbers
        start = {"z": 0.0285 + height, "x_rate": 0.1}
        motion = jj.simulate(Ball(bounce=bounce), start, ts=[2.5, 3.0], rtol=1e-10, atol=1e-10)
        return motion.phases.ts[9], (motion.phases.ts[9], motion.phase("cloth"), motion["z"][-1])

    slopes, (time, phase, z) = jax.jit(jax.jacfwd(tenth, has_aux=True))(jnp.array([0.7, 1.0]))
    assert_allclose(time, 2.47360446364125, rtol=1e-12)
    assert_allclose(slopes, [8.53571984478680, 1.23680223182063], rtol=1e-10)
    assert phase.tolist() == [0, 1]
    assert_allclose(z, 0.0285, rtol=1e-14)


def at_rest(motion):
    """The time at which the bounces of the only contact end."""
    return jnp.min(jnp.where(motion.phases.modes[0, 1:] > 0, motion.phases.ts, jnp.inf))


def settled(bounce, **options):
    """A ball after its bounces."""
    options = {"rtol": 1e-10, "atol": 1e-10} | options
    return jj.simulate(Ball(bounce=bounce), {"z": 1.0285, "x_rate": 0.1}, ts=[0.4, 3.0], **options)


def test_bounces_by_lanes_end_at_the_limits_of_their_series():
    def found(e):
        motion = settled(e)
        return at_rest(motion), motion.energies().balance

    e = jnp.array([0.7, 0.0, 0.1, 0.3, 0.5, 0.6, 0.69, 0.2])
    times, balance = jax.vmap(found)(e)
    assert_allclose(times, np.sqrt(2 / G) * (1 + e) / (1 - e), rtol=1e-10)
    assert_allclose(times[0], 2.55863396558581, rtol=1e-11)
    assert_allclose(balance, 0.17 * (G * 1.0285 + 0.1**2 / 2), rtol=1e-11)


class TwoBlocks(Ball):
    """Two blocks that do not meet."""

    bounce: float = jj.parameter(0.5)
    coordinates = jj.coordinates("x z other_x other_z")

    def bodies(self, t, q):
        here, there = [q.x, 0.0, q.z], [q.other_x, 1.0, q.other_z]
        return {
            name: jj.RigidBody(self.mass, jnp.eye(3), place, jnp.eye(3))
            for name, place in {"one": here, "other": there}.items()
        }

    def contacts(self, pose):
        law = {"height": "row", "friction": self.friction, "restitution": self.bounce}
        return {name: jj.ball_contact(pose[name], self.radius, **law) for name in ("one", "other")}


def test_bodies_that_do_not_meet_move_as_each_alone():
    """A block slides and bounces: v_x falls by mu g dt on the ground and by mu (1 + e) v_z in each impact.
    The other block, at rest or sliding on the ground at an impact, stays there.
    """
    heights, speeds = jax.random.uniform(jax.random.key(0), (2, 2, 60))
    heights = jnp.where(heights < 0.4, 0.0, 0.3 * heights)
    speeds = jnp.where(speeds < 0.3, 0.0, speeds)
    scene = TwoBlocks()

    def ends(height, speed):
        """Return x and z at 1.5 s, when all rest."""
        mu, e = scene.friction, scene.bounce
        fall = jnp.sqrt(2 * height / G)
        x, rise = speed * fall, G * fall
        for _ in range(40):
            speed = jnp.maximum(speed - mu * (1 + e) * rise, 0.0)
            rise = e * rise
            x += speed * 2 * rise / G
        return jnp.stack([x + speed**2 / (2 * mu * G), scene.radius + 0 * x])

    def found(heights, speeds):
        (z, other_z), (x_rate, other_x_rate) = scene.radius + heights, speeds
        start = {"z": z, "other_z": other_z, "x_rate": x_rate, "other_x_rate": other_x_rate}
        motion = jj.simulate(scene, start, ts=[1.5], rtol=1e-9, atol=1e-9)
        places = [[motion[f"{whose}{axis}"][0] for axis in "xz"] for whose in ("", "other_")]
        return motion.result, jnp.array(places)

    result, places = jax.vmap(found, in_axes=1)(heights, speeds)
    assert_array_equal(result, SUCCESS)
    assert_allclose(places, jnp.moveaxis(ends(heights, speeds), (0, 1, 2), (2, 1, 0)), atol=1e-10)


class Tilted(Ball):
    """A ball on a slope, in coordinates along it."""

    slope: float = jj.parameter(0.2)

    def loads(self, motion):
        weight = self.mass * self.g * jnp.stack([jnp.sin(self.slope), jnp.zeros(()), -jnp.cos(self.slope)])
        return jj.Load(forces={"ball": weight})


class OnSphere(Heavy):
    """A ball in a plane on top of a fixed sphere."""

    friction: float = jj.parameter(0.5)
    coordinates = jj.coordinates("x z turn")

    def bodies(self, t, q):
        return {"ball": jj.RigidBody.ball(1.0, 0.1, position=[q.x, 0.0, q.z], orientation=jj.rot_y(q.turn))}

    def contacts(self, pose):
        ground = jj.Sphere(0.9, side="outside")
        return {
            "ground": jj.ball_contact(pose["ball"], 0.1, ground=ground, height="row", friction=self.friction)
        }


def test_a_ball_slips_and_lifts_off_a_sphere():
    def phases(friction):
        start = {"z": 1.0, "x_rate": 0.1, "turn_rate": 1.0}
        found = jj.simulate(OnSphere(friction=friction), start, t1=1.6, **FINE).phases
        return found.ts, (found.ts, found.modes)

    slopes, (ts, modes) = jax.jit(jax.jacfwd(phases, has_aux=True))(0.5)
    assert_allclose(ts[:2], [1.3847002479896, 1.473754099443], rtol=1e-11)
    assert modes[0][:3].tolist() == [1, 2, 0]  # rolls, slips, flies
    assert_allclose(slopes[1], 0.019794092885, rtol=1e-9)


class DoublePendulum(jj.Scene):
    """Two rods of 1 m and 1 kg in a plane; the lower end strikes a floor."""

    coordinates = jj.coordinates("a b")
    impact = "moreau"

    def bodies(self, t, q):
        upper, lower = jj.rot_y(-q.a), jj.rot_y(-q.b)
        down, moments = jnp.array([0.0, 0.0, -1.0]), (1 / 12, 1 / 12, 0.0)
        return {
            "upper": jj.RigidBody(1.0, moments, upper @ down / 2, upper),
            "lower": jj.RigidBody(1.0, moments, upper @ down + lower @ down / 2, lower),
        }

    def contacts(self, pose):
        lower = pose["lower"]
        floor = jj.Plane(origin=(0.0, 0.0, -np.cos(0.95) - np.cos(0.64)))
        return {
            "floor": jj.Contact(
                lower,
                lower.place((0.0, 0.0, -0.5)),
                floor,
                "row",
                friction=0.5,
                restitution=0.7,
                impact=self.impact,
            )
        }


@pytest.mark.parametrize(
    ("law", "rates", "gained"),
    [
        ("newton", (0.915089365149, 0.716488935267), -0.392783723957),
        ("poisson", (0.018640150251, 0.575598620974), -1.288242066472),
        ("energetic", (0.206481769471, 0.605120722538), -1.199854588715),
    ],
)
def test_impacts_along_the_impulse(law, rates, gained):
    scene = type("Law", (DoublePendulum,), {"impact": law})()
    motion = jj.simulate(
        scene, {"a": 0.95, "b": 0.64, "a_rate": -0.26, "b_rate": -2.45}, ts=[1e-9, 1e-2], **FINE
    )
    assert_allclose(motion.u[0], rates, rtol=1e-7)
    a, b, first, second = (motion[name] for name in ("a", "b", "a_rate", "b_rate"))
    kinetic = 2 / 3 * first**2 + second**2 / 6 + first * second * np.cos(a - b) / 2
    assert_allclose(kinetic - 1.3488015753419331, gained, rtol=1e-10)


def test_an_impact_that_would_gain_energy_has_a_code():
    """By Newton's restitution and Coulomb's law on the slip afterwards the pendulum would gain 2.13 J (Kane's
    paradox).
    """
    start = {"a": 0.95, "b": 0.64, "a_rate": -0.26, "b_rate": -2.45}
    back = {"a": 0.95 + 0.26e-3, "b": 0.64 + 2.45e-3}
    struck = jj.simulate(DoublePendulum(), start | back, t1=0.1)
    assert "would gain energy" in struck.message
    at_once = jj.simulate(DoublePendulum(), start, t1=0.1)
    assert "would gain energy" in at_once.message


class Energetic(Ball):
    """A ball, or a body of other moments of inertia, with Stronge's law of restitution."""

    moments: object = jj.parameter((0.4, 0.4, 0.4))  # over m R^2

    def bodies(self, t, q):
        moments = jnp.asarray(self.moments) * self.mass * self.radius**2
        return {
            "ball": jj.RigidBody(self.mass, moments, [q.x, q.y, q.z], jj.quaternion_to_matrix(q.attitude))
        }

    def contacts(self, pose):
        law = {"height": "row", "friction": self.friction, "restitution": self.bounce}
        return {"cloth": jj.ball_contact(pose["ball"], self.radius, impact="energetic", **law)}


def test_a_ball_bounces_with_spin():
    """v (2, -3) m/s, spin -10 rad/s: it grips where mu = 0.5."""
    for friction, speed, spin in ((0.05, 1.73, 3.5), (0.5, 1.28571428571428571, 25.7142857142857143)):
        scene = Energetic(mass=1.0, radius=0.05, friction=friction, bounce=0.8, g=0.0)
        motion = jj.simulate(
            scene, {"z": 0.05, "x_rate": 2.0, "z_rate": -3.0, "attitude_omega_y": -10.0}, ts=[0.1]
        )
        assert_allclose(
            [motion[name][0] for name in ("x_rate", "z_rate", "attitude_omega_y")],
            [speed, 2.4, spin],
            rtol=1e-12,
        )


def test_impacts_where_slip_turns_have_a_code_along_the_impulse():
    """Of a body whose moments differ, by an impulse across its axes."""
    scene = Energetic(moments=(0.2, 0.4, 0.5), radius=0.05, bounce=0.8)
    motion = jj.simulate(
        scene, {"z": 0.1, "x_rate": 2.0, "z_rate": -3.0, "attitude_omega": (8.0, -10.0, 3.0)}, ts=[0.1]
    )
    assert "slip reverses during an impact" in motion.message


class Rod(Heavy):
    """A rod in a plane, whose lower end touches the floor."""

    friction: float = jj.parameter(1.0)
    coordinates = jj.coordinates("x z a")

    def bodies(self, t, q):
        return {"rod": jj.RigidBody(1.0, (0.0, 1 / 12, 1 / 12), [q.x, 0.0, q.z], jj.rot_y(-q.a))}

    def contacts(self, pose):
        return {
            "end": jj.Contact(
                pose["rod"], pose["rod"].place((-0.5, 0.0, 0.0)), height="row", friction=self.friction
            )
        }


def test_coulombs_law_has_no_answer_for_a_rod():
    """Painleve: where mu >= (1 + 3 cos^2 a)/(3 sin a cos a), for slip towards the rod's foot."""
    most = (1 + 3 * np.cos(1.0) ** 2) / (3 * np.sin(1.0) * np.cos(1.0))
    assert_allclose(most, 1.375259396131)
    start = {"a": 1.0, "z": 0.5 * np.sin(1.0)}
    for speed, friction, right in (
        (-1.0, 0.9995 * most, True),
        (-1.0, 1.0005 * most, False),
        (1.0, 2 * most, True),
    ):
        motion = jj.simulate(Rod(friction), start | {"x_rate": speed}, ts=[1e-3])
        assert (motion.result == 0) == right


class Hoop(Heavy):
    """A hoop in a plane with a heavy bead on its rim."""

    coordinates = jj.coordinates("x z turn")

    def bodies(self, t, q):
        turn, centre = jj.rot_y(q.turn), jnp.stack([q.x, 0.0 * q.x, q.z])
        hoop = jj.RigidBody(0.2, 0.2 * jnp.diag(jnp.array([0.5, 1.0, 0.5])), centre, turn)
        return {"hoop": hoop, "bead": jj.Particle(1.0, centre + turn @ jnp.array([0.0, 0.0, 1.0]))}

    def contacts(self, pose):
        return {"rim": jj.disc_contact(pose["hoop"], 1.0, height="row", friction=0.6)}


def test_a_hoop_slips_and_rolls_again():
    """In a plane, where nothing moves across: the second tangent has no force."""
    times = [1.880372501087, 2.017805766802]
    motion = jj.simulate(Hoop(), {"z": 1.0, "turn_rate": 0.3, "x_rate": 0.3}, ts=[*times, 2.1], **FINE)
    assert_allclose(motion.phases.ts[:2], times, rtol=1e-11)
    assert_allclose([motion["turn"][0], motion["x"][1]], [1.888898912431, 2.607814697168], rtol=1e-11)


class Coin(Heavy):
    """A coin above a table."""

    friction: float = jj.parameter(0.3)
    bounce: float = jj.parameter(0.5)
    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def bodies(self, t, q):
        moments = 0.01 * 0.012**2 * np.array([0.25, 0.5, 0.25])
        return {"coin": jj.RigidBody(0.01, moments, [q.x, q.y, q.z], jj.quaternion_to_matrix(q.attitude))}

    def contacts(self, pose):
        return {
            "rim": jj.disc_contact(
                pose["coin"], 0.012, height="row", friction=self.friction, restitution=self.bounce
            )
        }


class RollingCoin(Coin):
    """A coin that cannot slip."""

    def contacts(self, pose):
        return {"rim": jj.disc_contact(pose["coin"], 0.012, height="row")}


def test_a_coin_with_much_friction_rolls_as_one_that_cannot_slip():
    rolling, lean = RollingCoin(), 0.3
    start = jj.start(
        rolling,
        attitude=(np.cos(lean / 2), np.sin(lean / 2), 0.0, 0.0),
        attitude_omega_y=30.0,
        near={"z": 0.0115},
    )
    kept = jj.simulate(rolling, start, ts=[0.5], **FINE)
    names = (*rolling.coordinate_names.entries, *rolling.speed_names.entries)
    free = jj.simulate(
        Coin(friction=1e6), dict(zip(names, [*start.q, *start.u], strict=True)), ts=[0.5], **FINE
    )
    assert not np.isfinite(free.phases.ts).any()
    assert_allclose(free.q[0][:7], kept.q[0], atol=1e-9)
    assert_allclose(free.u[0], kept.u[0], atol=1e-8)


def test_small_motions_of_a_ball_that_slips():
    """dv/dt = -mu g w/|w| with the slip w = v + omega x (-R n), and of omega by the same force."""
    speeds = ["x_rate", "y_rate", "attitude_omega_x", "attitude_omega_y"]
    found = jj.linearize(Ball(), SLIDING)
    assert len(found.states) == 11 - 1
    rows = [found.states.index(name) for name in speeds]
    W = np.array([[1.0, 0.0, 0.0, -0.0285], [0.0, 1.0, 0.0285, 0.0]])
    w = W @ [3.0, 0.4, 5.0, -12.0]
    across = np.eye(2) - np.outer(w, w) / (w @ w)
    slopes = -0.2 * G * across / np.linalg.norm(w) @ W
    A = np.asarray(found.A)[np.ix_(rows, rows)]
    assert_allclose(A[:2], slopes, atol=1e-12)
    assert_allclose(A[2:], 2.5 / 0.0285 * np.array([slopes[1], -slopes[0]]), atol=1e-9)
    end = jj.simulate(Ball(), SLIDING, ts=[0.1]).end
    names = (*Ball.coordinates.names.entries, *end.names[1].entries)
    same = jj.linearize(Ball(), {name: end[name] for name in names})
    assert_allclose(jj.linearize(Ball(), end).A, same.A, atol=1e-9)


def test_dropped_coins():
    """Energy is lost where an impact or friction takes it; lanes give what each motion gives alone."""
    assert not jj.lower(Coin()).sided  # a direction of slip that passes an axis is no event
    attitude = np.random.default_rng(0).normal(size=(4, 4))
    attitude /= np.linalg.norm(attitude, axis=1)[:, None]
    starts = {
        "z": np.full(4, 0.03),
        "attitude": attitude,
        "x_rate": np.array([0.2, -0.1, 0.3, 0.0]),
        "attitude_omega_y": np.full(4, 10.0),
    }
    how = {"ts": [0.1, 0.15], "rtol": 1e-10, "atol": 1e-10}
    together = jj.rollout(Coin(), starts, **how)
    for i in range(4):
        alone = jj.simulate(Coin(), {name: x[i] for name, x in starts.items()}, **how)
        assert alone.succeeded
        assert np.isfinite(alone.phases.ts).sum() >= 2
        assert_array_equal(alone.q, together.lane(i).q)
        balance = np.asarray(alone.energies().balance)
        assert_allclose(balance, balance[0], atol=1e-9 * 0.01 * G * 0.03)


class Kept(Ball):
    """A ball that its coordinates are said to keep on the ground."""

    def contacts(self, pose):
        return {"cloth": jj.ball_contact(pose["ball"], self.radius, friction=self.friction)}


def test_bad_contacts():
    refused("cannot leave the ground; give the body a coordinate for its height, and write height=", Kept)
    refused(
        r"the friction of contact `cloth` of `Ball` is -0\.1, expected a coefficient that is not negative",
        jj.simulate,
        Ball(friction=-0.1),
        SLIDING,
        t1=0.1,
    )
    refused(
        r"the restitution of contact `cloth` of `Ball` is 1\.2, expected a number from 0 to 1",
        jj.simulate,
        Ball(bounce=1.2),
        SLIDING,
        t1=0.1,
    )
    refused(
        r"contacts with friction, which cannot run backward in time from t0 = 0\.0 to t1 = -1\.0 s",
        jj.simulate,
        Ball(),
        SLIDING,
        t1=-1.0,
    )
    refused(
        "`family` supports only contacts that never slip, but `cloth` of `Ball` may slip",
        jj.family,
        Ball(),
        {"z": 0.0285},
    )
    refused(
        r"contacts with friction of `Tilted` \(cloth\) must fly, roll or slip",
        jj.linearize,
        Tilted(friction=0.01, slope=0.5),
        {"z": 0.0285},
    )
    refused(r"of `Sled` \(blade, heading_rate\) must fly, roll or slip in a", jj.steady, Sled(), {})
    below = jj.simulate(Ball(), SLIDING | {"z": 0.02}, t1=0.1)
    assert "a body starts below the ground" in below.message

    def end(friction):
        return jj.simulate(Ball(friction=friction), SLIDING, ts=[0.1]).result

    assert jax.vmap(end)(jnp.array([0.2, -0.1])).tolist() == [0, 7]


def test_a_start_in_contact():
    """A body that strikes at its start rebounds; one at rest on a slope slips at once where friction cannot
    hold it.
    """
    struck = jj.simulate(Ball(bounce=0.5), {"z": 0.0285, "z_rate": -1.0}, ts=[0.01])
    assert_allclose(struck["z_rate"], [0.5 - G * 0.01], rtol=1e-12)

    bound = 2 / 7 * np.tan(0.5)
    for friction, phase in ((0.9 * bound, 2), (1.1 * bound, 1)):
        slope = Tilted(friction=friction, slope=0.5)
        motion = jj.simulate(slope, {"z": 0.0285}, ts=[0.15, 0.3], **FINE)
        assert motion.phase("cloth").tolist() == [phase] * 2
        along = G * (np.sin(0.5) - friction * np.cos(0.5)) if phase == 2 else 5 / 7 * G * np.sin(0.5)
        assert_allclose(motion["x_rate"][1], along * 0.3, rtol=1e-8)


class Cart(Heavy):
    """A block on two runners, in a plane."""

    bounce: float = jj.parameter(0.0)
    friction: float = jj.parameter(0.3)
    coordinates = jj.coordinates("x z pitch")

    def bodies(self, t, q):
        return {"cart": jj.RigidBody(10.0, jnp.ones(3), [q.x, 0.0, q.z], jj.rot_y(q.pitch))}

    def contacts(self, pose):
        def runner(x):
            law = {"height": "row", "friction": self.friction, "restitution": self.bounce}
            return jj.ball_contact(pose["cart"], 0.05, centre=(x, 0.0, -0.45), **law)

        return {"front": runner(0.6), "rear": runner(-0.4)}


def test_a_cart_brakes_on_two_runners():
    """Loads (b + mu h)/w and (w - b - mu h)/w of the weight, b = 0.4, h = 0.5, w = 1 m; all of it stops."""
    motion = jj.simulate(Cart(), {"z": 0.5, "x_rate": 0.6}, ts=[0.1, 0.3], **FINE)
    forces = motion.contact_forces()
    weight = 10 * G
    assert_allclose(
        [forces["front"].normal[0], forces["rear"].normal[0]], [0.55 * weight, 0.45 * weight], rtol=1e-10
    )
    assert_allclose(motion["x"][-1], 0.6**2 / (2 * 0.3 * G), rtol=1e-9)
    assert [motion.phase(name).tolist() for name in ("front", "rear")] == [[2, 1], [2, 1]]


def test_a_cart_falls_onto_two_runners():
    """The front strikes and slips; as the rear strikes, both stick, whatever round-off says of the slip that
    is left.
    """
    for ts in ([1.0], [0.1, 0.2, 1.0]):
        motion = jj.simulate(Cart(), {"z": 0.6, "pitch": 0.1, "x_rate": 0.3}, ts=ts, rtol=1e-9, atol=1e-9)
        assert [motion.phase(name)[-1] for name in ("front", "rear")] == [1, 1]
        assert_allclose([motion["x_rate"][-1], motion["pitch"][-1]], 0.0, atol=1e-12)
        assert_allclose(motion.energies().balance, motion.energies().balance[0], atol=1e-8)


def test_a_cart_clatters_until_it_rests():
    """Runners without friction strike in turn, at shrinking intervals, until the cart stands on both. The
    rebound of one may be lower than round-off while the other has just struck.
    """
    drawn = jax.random.uniform(jax.random.key(0), (4, 200), minval=-1.0)

    def end(pitch, pitch_rate, speed, bounce):
        scene = Cart(friction=0.0, bounce=jnp.maximum(0.1 + 0.2 * bounce, 0.0))
        start = {"z": 0.7, "pitch": 0.15 * pitch, "pitch_rate": pitch_rate, "x_rate": speed}
        motion = jj.simulate(scene, start, ts=[4.0], rtol=1e-8, atol=1e-8)
        return motion.result, motion.q[0, :3]

    result, q = jax.vmap(end)(*drawn)
    assert_array_equal(result, SUCCESS)
    assert_allclose(q.T, [4 * drawn[2], jnp.full(200, 0.5), jnp.zeros(200)], atol=1e-10)


class Belt(jj.Scene):
    """A block of 1 kg at a spring of 40 N/m on a belt of 0.1 m/s."""

    static: float = jj.parameter(0.4)
    sliding: float = jj.parameter(0.25)
    coordinates = jj.coordinates("x z")

    def bodies(self, t, q):
        return {"block": jj.RigidBody(1.0, jnp.ones(3), [q.x, 0.0, q.z], jnp.eye(3))}

    def loads(self, motion):
        return (jj.gravity(motion, G), jj.generalized_force(motion, x_rate=-40.0 * motion.q.x))

    def contacts(self, pose):
        law = {"height": "row", "friction": jj.Coulomb(self.sliding, static=self.static)}
        return {"belt": jj.ball_contact(pose["block"], 0.1, ground=jj.Plane(velocity=(0.1, 0.0, 0.0)), **law)}


def test_a_block_sticks_and_slips_on_a_belt():
    """With more static friction the force jumps as slip begins; a period 1.360846391399 s."""

    def period(static):
        ts = jj.simulate(Belt(static), {"z": 0.1, "x_rate": 0.1}, t1=4.0, **FINE).phases.ts
        return ts[2] - ts[0]

    slope, value = with_value(jax.jacfwd, period)(0.4)
    assert_allclose(value, 1.360846391399, rtol=1e-10)
    assert_allclose(slope, 4.14018082448, rtol=1e-7)
    refused(
        r"static friction of contact `belt` of `Belt` is 0\.2, expected at least the coefficient of"
        r" sliding, 0\.25",
        jj.simulate,
        Belt(0.2),
        {"z": 0.1},
        t1=0.1,
    )


def test_a_block_slips_at_rest_on_its_belt():
    """Where the spring holds the friction, x = mu N/k; it swings about this place by the spring alone."""

    def still(sliding):
        return jj.steady(Belt(0.4, sliding), {"z": 0.1, "x": 0.05}).state

    slope, state = jax.jacfwd(still)(0.25), still(0.25)
    assert_allclose([state["x"], slope.q[0]], [0.25 * G / 40.0, G / 40.0], rtol=1e-12)
    small = jj.linearize(Belt(), state)
    assert small.states == ("x", "x_rate")
    assert_allclose(small.state_eigenvalues().imag, [-np.sqrt(40.0), np.sqrt(40.0)], rtol=1e-12)
    assert_allclose(small.state_eigenvalues().real, 0.0, atol=1e-12)
    from_rest = jj.simulate(Belt(), state, ts=[1.0], **FINE)
    assert_allclose(from_rest.q_end[0], state["x"], rtol=1e-12)
    assert from_rest.phase("belt")[0] == 2


class Kerb(Heavy):
    """A ball that rolls in a plane against an edge 0.02 m above its floor."""

    coordinates = jj.coordinates("x z turn")
    domain = {"x": (-1.0, -0.1), "z": (0.1, 0.3)}

    def bodies(self, t, q):
        return {"ball": jj.RigidBody(1.0, 0.4 * 0.01 * jnp.eye(3), [q.x, 0.0, q.z], jj.rot_y(q.turn))}

    def contacts(self, pose):
        edge = jj.Cylinder(1e-7, axis=(0.0, 1.0, 0.0), origin=(0.0, 0.0, 0.02), side="outside")
        law = {"height": "row", "friction": 5.0}
        return {
            "floor": jj.ball_contact(pose["ball"], 0.1, **law),
            "edge": jj.ball_contact(pose["ball"], 0.1, ground=edge, **law),
        }


@pytest.mark.parametrize(("speed", "climbs"), [(0.617, False), (0.618, True)])
def test_a_kerb(speed, climbs):
    """The floor lets go as the edge is struck; speed after/before 6/7; 0.617656862667 m/s climb."""
    motion = jj.simulate(
        Kerb(), {"x": -0.3, "z": 0.1, "x_rate": speed, "turn_rate": 10 * speed}, ts=[3.0], max_transitions=200
    )
    assert_allclose(motion.phases.lost[0] / (0.7 * speed**2), 1 - (6 / 7) ** 2, rtol=1e-5)
    assert motion.phases.modes[:, 1].tolist() == [0, 1]
    assert bool(motion["x"][0] > 0) == climbs


def test_an_elastic_bounce_runs_backwards():
    """From the end with reversed speeds the ball comes back to where it began."""
    smooth = Ball(bounce=1.0, friction=0.0)
    there = jj.simulate(smooth, {"z": 0.3, "x_rate": 0.5, "z_rate": -0.2}, ts=[0.6], **FINE)
    back = {name: there[name][0] for name in "xyz"} | {
        f"{name}_rate": -there[f"{name}_rate"][0] for name in "xyz"
    }
    begun = jj.simulate(smooth, back, ts=[0.6], **FINE)
    assert np.isfinite(there.phases.ts).sum() == 1
    ends = [begun[name][0] for name in ("x", "z", "x_rate", "z_rate")]
    assert_allclose(ends, [0.0, 0.3, -0.5, 0.2], atol=1e-12)


class Scooter(Ball):
    """A rigid body on two balls in space; `order`: of its contacts."""

    order: tuple[str, ...] = eqx.field(static=True, default=("front", "rear"))
    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def bodies(self, t, q):
        moments = jnp.array([0.02, 0.05, 0.06]) * self.mass
        return {
            "ball": jj.RigidBody(self.mass, moments, [q.x, q.y, q.z], jj.quaternion_to_matrix(q.attitude))
        }

    def contacts(self, pose):
        law = {"height": "row", "friction": self.friction, "restitution": self.bounce}
        centres = {"front": jnp.array([0.4, 0.0, 0.0]), "rear": jnp.array([-0.4, 0.0, 0.0])}
        return {
            name: jj.ball_contact(pose["ball"], self.radius, centre=centres[name], **law)
            for name in self.order
        }


SCOOTER = {"mass": 1.0, "radius": 0.1, "friction": 0.4, "bounce": 0.3}


def test_contacts_that_close_together_strike_together():
    """Dropped flat on both, the body stays level and slips by the impulse of both, in either order of the
    contacts.
    """
    start = {"z": 0.1 + 0.2, "y_rate": 2.5}
    ends = []
    for order in (("front", "rear"), ("rear", "front")):
        motion = jj.simulate(Scooter(**SCOOTER, order=order), start, ts=[0.21], **FINE)
        assert motion.phase("front")[0] == motion.phase("rear")[0] == 0
        ends.append(
            [motion[name][0] for name in ("z", "z_rate", "y_rate", "attitude_omega_x", "attitude_omega_y")]
        )
    fall = np.sqrt(2 * 0.2 / G)
    rebound = 0.3 * G * fall
    after = 0.21 - fall
    height, speed = 0.1 + rebound * after - G * after**2 / 2, rebound - G * after
    sideways = 2.5 - 0.4 * 1.3 * G * fall
    turned = 0.4 * 1.3 * G * fall * 0.1 / 0.02
    assert_allclose(ends[0], [height, speed, sideways, -turned, 0.0], atol=1e-11)
    assert_array_equal(ends[0][:4], ends[1][:4])  # the last one is round-off in both orders
    assert_allclose([ends[0][4], ends[1][4]], 0.0, atol=1e-16)


class TippeTop(Ball):
    """A ball whose mass centre is off its centre, along its axis of symmetry."""

    def bodies(self, t, q):
        moments = jnp.array([4.0, 4.0, 3.6]) * self.mass * self.radius**2 / 10
        return {
            "ball": jj.RigidBody(self.mass, moments, [q.x, q.y, q.z], jj.quaternion_to_matrix(q.attitude))
        }

    def contacts(self, pose):
        law = {"height": "row", "friction": self.friction, "restitution": self.bounce}
        return {
            "cloth": jj.ball_contact(pose["ball"], self.radius, centre=jnp.array([0.0, 0.0, 0.004]), **law)
        }


def test_jelletts_integral_of_a_tippe_top():
    """L.(point of contact - mass centre) is constant while it flies, slips and rolls, and in impacts."""
    top = TippeTop(mass=0.02, radius=0.02, friction=0.25, bounce=0.4)
    attitude = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    start = {
        "z": 0.02 - 0.004 * np.cos(0.2) + 0.001,
        "attitude": attitude,
        "attitude_omega": (0.0, 3.0, 150.0),
    }
    motion = jj.simulate(top, start, ts=np.linspace(0.0, 1.0, 41), max_transitions=300, **FINE)
    integral = []
    for q, u in zip(motion.q, motion.u, strict=True):
        R = np.asarray(jj.quaternion_to_matrix(q[3:7]))
        momentum = R @ (np.diag([4.0, 4.0, 3.6]) * 0.02 * 0.02**2 / 10) @ u[3:6]
        integral.append(momentum @ (R @ np.array([0.0, 0.0, 0.004]) - np.array([0.0, 0.0, 0.02])))
    assert_allclose(integral, integral[0], rtol=1e-10)
    assert np.isfinite(motion.phases.ts).sum() > 3


@pytest.mark.parametrize("bounce", [0.0, 0.5])
def test_a_disc_that_falls_flat_has_a_code(bounce):
    attitude = np.array([np.cos(0.15), np.sin(0.15), 0.0, 0.0])
    motion = jj.simulate(Coin(bounce=bounce), {"z": 0.02, "attitude": attitude}, t1=1.0)
    assert "fell flat on its ground" in motion.message
    assert abs(motion.q_end[2]) < 1e-5


class Sled(jj.Scene):
    """A body on a blade that holds up to 3 N, with friction of its heading."""

    coordinates = jj.coordinates("x y heading")

    def bodies(self, t, q):
        return {"sled": jj.RigidBody(2.0, jnp.ones(3), [q.x, q.y, 0.0], jj.rot_z(q.heading))}

    def velocity_constraints(self, motion):
        sled = motion["sled"]
        return {"blade": jj.knife_edge(sled, sled.position, sled.orientation[:, 1], holds=3.0)}

    def loads(self, motion):
        friction = jj.joint_friction(motion, heading_rate=jj.Coulomb(0.1, static=0.2))
        return friction, jj.generalized_force(motion, heading_rate=jnp.sin(motion.t))


def test_dense_matrices_begin_with_the_trace_that_lowering_has_read():
    """Both start from one trace of the scene, which lowering must not change. XLA would take 40 s."""
    start = {"x_rate": 2.0, "heading_rate": 1.0}
    by_program, by_matrices = (
        jax.eval_shape(lambda way=way: jj.simulate(Sled(), start, ts=[1.5], backend=way, **FINE))
        for way in ("native", "dense")
    )
    assert by_matrices.q.shape == by_program.q.shape
    assert by_matrices.phases.modes.shape == by_program.phases.modes.shape


class Braking(Heavy):
    """A bicycle in its plane: the rear wheel turns, all else is one body, since the front wheel is locked."""

    mass: float = jj.parameter(16.0, positive=True)  # of this body; x, z: its centre, from the rear contact
    inertia: float = jj.parameter(3.0, positive=True)
    x: float = jj.parameter(0.5)
    z: float = jj.parameter(0.5)
    wheel: float = jj.parameter(3.0, positive=True)
    turning: float = jj.parameter(0.15, positive=True)
    rear: float = jj.parameter(0.34, positive=True)
    front: float = jj.parameter(0.34, positive=True)
    base: float = jj.parameter(1.1, positive=True)
    friction: float = jj.parameter(0.5)
    coordinates = jj.coordinates("x z pitch turn")

    def placed(self, q, mass, inertia, x, z, angle):
        """A body at a place of the frame, from the rear contact."""
        at = jnp.stack([q.x, 0.0, q.z]) + jj.rot_y(q.pitch) @ jnp.stack([x, 0.0, z - self.rear])
        return jj.RigidBody(mass, inertia * jnp.ones(3), at, jj.rot_y(angle))

    def bodies(self, t, q):
        return {
            "frame": self.placed(q, self.mass, self.inertia, self.x, self.z, q.pitch),
            "wheel": self.placed(q, self.wheel, self.turning, 0.0, self.rear, q.turn),
        }

    def contacts(self, pose):
        law = {"height": "row", "friction": self.friction}
        axle = jnp.stack([self.base - self.x, 0.0, self.front - self.z])
        return {
            "front": jj.ball_contact(pose["frame"], self.front, centre=axle, **law),
            "rear": jj.ball_contact(pose["wheel"], self.rear, **law),
        }


def as_one_body(v, names):
    """Mass, moment of inertia and centre of these parts of a measured bicycle."""
    parts = {"B": (v["xB"], -v["zB"]), "H": (v["xH"], -v["zH"]), "F": (v["w"], v["rF"])}
    m, (x, z) = np.array([v[f"m{name}"] for name in names]), np.array([parts[name] for name in names]).T
    mass, x0, z0 = m.sum(), m @ x / m.sum(), m @ z / m.sum()
    inertia = sum(v[f"I{name}yy"] for name in names) + m @ ((x - x0) ** 2 + (z - z0) ** 2)
    return {"mass": mass, "inertia": inertia, "x": x0, "z": z0}


def braking(v):
    """Parameters of `Braking` of a measured bicycle, and the friction (w - b)/h beyond which it tips over."""
    own = as_one_body(v, "BHF") | {"wheel": v["mR"], "turning": v["IRyy"]}
    mass, x0, z0 = own["mass"], own["x"], own["z"]
    b, h = mass * x0, mass * z0 + v["mR"] * v["rR"]  # times the whole mass
    limit = (v["w"] * (mass + v["mR"]) - b) / h
    return own | {"rear": v["rR"], "front": v["rF"], "base": v["w"]}, limit


def test_measured_bicycles_brake():
    """With the front wheel locked it slides, or the rear wheel lifts: by statics from mu h = w - b on."""
    names = sorted(shipped_bicycles().keys() - {"Tms"})
    found = [braking(measured_bicycle(name).values) for name in names]
    many = {key: jnp.repeat(jnp.array([own[key] for own, _ in found]), 2) for key in found[0][0]}
    friction = jnp.ravel(jnp.array([[0.95 * limit, 1.05 * limit] for _, limit in found]))

    def stopping(own):
        scene = Braking(**own)
        start = {"z": scene.rear, "x_rate": 6.0, "turn_rate": 6.0 / scene.rear}
        motion = jj.simulate(scene, start, ts=[0.1, 0.2], rtol=1e-9, atol=1e-9)
        return motion.succeeded, motion.phase("front"), motion.phase("rear"), motion["pitch"]

    succeeded, front, rear, pitch = jax.vmap(stopping)(many | {"friction": friction})
    assert len(names) == 11
    assert succeeded.all()
    assert (front == 2).all()
    assert (rear[::2] > 0).all()
    assert (rear[1::2] == 0).all()
    assert_allclose(pitch[::2], 0.0, atol=1e-12)
    assert (pitch[1::2, 1] > 0.01).all()


class OffKerb(Braking):
    """A bicycle in its plane, whose wheels turn, on a road that ends 0.1 m above the next one."""

    wheels: object = jj.parameter((3.0, 3.0))
    turns: object = jj.parameter((0.15, 0.15))
    coordinates = jj.coordinates("x z pitch rear front")

    def bodies(self, t, q):
        (rear, front), (own, other) = self.wheels, self.turns
        return {
            "frame": self.placed(q, self.mass, self.inertia, self.x, self.z, q.pitch),
            "rear": self.placed(q, rear, own, 0.0, self.rear, q.rear),
            "front": self.placed(q, front, other, self.base, self.front, q.front),
        }

    def contacts(self, pose):
        def wheel(name, radius):
            """On the upper road and its edge, or on the lower road, whichever is nearer."""
            centre = pose[name].position
            arm = centre - jnp.stack([jnp.minimum(centre[0], 0.0), centre[1], 0.1])
            away = jnp.sqrt(arm @ arm)
            gap = jnp.minimum(away, centre[2]) - radius
            n = jnp.where(away < centre[2], arm / away, jnp.array([0.0, 0.0, 1.0]))
            point = centre - radius * n
            plane = jj.Plane(point - gap * n, normal=n)
            return jj.Contact(pose[name], point, plane, "row", distance=gap, friction=self.friction)

        return {"rear": wheel("rear", self.rear), "front": wheel("front", self.front)}


def test_measured_bicycles_ride_off_a_kerb():
    """Each wheel leaves the edge as it comes to it, since v^2/r exceeds its acceleration there. Friction
    changes speeds but not `p + sum J w/r`; so the speed is the same at the end, and weight times height is
    lost in impacts and by slip.
    """
    values = [measured_bicycle(name).values for name in sorted(shipped_bicycles().keys() - {"Tms"})]
    found = [
        as_one_body(v, "BH")
        | {"wheels": (v["mR"], v["mF"]), "turns": (v["IRyy"], v["IFyy"])}
        | {"rear": v["rR"], "front": v["rF"], "base": v["w"]}
        for v in values
    ]
    many = {key: jnp.repeat(jnp.array([own[key] for own in found]), 3, axis=0) for key in found[0]}
    speeds = jnp.tile(jnp.array([3.0, 4.5, 6.0]), len(found))

    def ride(own, v):
        scene = OffKerb(**own, friction=0.8)
        start = {"x": -1.4, "z": 0.1 + scene.rear, "x_rate": v}
        start |= {"rear_rate": v / scene.rear, "front_rate": v / scene.front}
        motion = jj.simulate(scene, start, ts=[0.3, 0.6, 1.5], rtol=1e-9, atol=1e-9)
        energies, at_end = motion.energies(), [motion[name][-1] for name in ("x_rate", "z", "pitch")]
        return motion.result, motion.phases.ts[0], energies, at_end

    result, first, energies, (x_rate, z, pitch) = jax.vmap(ride)(many, speeds)
    assert result.tolist() == [SUCCESS] * 33
    assert_allclose(first, (1.4 - many["base"]) / speeds, rtol=1e-12)
    assert_allclose(x_rate, speeds, rtol=1e-10)
    assert_allclose([z - many["rear"], pitch], 0.0, atol=1e-14)
    weight = G * (many["mass"] + jnp.sum(many["wheels"], axis=1))
    assert_allclose(energies.balance, energies.balance[:, :1] + jnp.zeros(3), rtol=1e-10)
    assert_allclose((energies.lost - energies.work)[:, -1], 0.1 * weight, rtol=1e-9)


def grip_and_lift(own, friction):
    """Grip that the rear wheel has left (N) if it rolls, and acceleration of its hub (m/s^2) if it lifts, by
    forces and moments while the front wheel slides. Unknowns: x'', z'' of the hub, pitch'', turn'', front
    load, rear load, rear friction.
    """
    m, M, I, J, R = (own[name] for name in ("mass", "wheel", "inertia", "turning", "rear"))
    X, Z, w = own["x"], own["z"] - R, own["base"]
    balance = [
        [m + M, 0, m * Z, 0, friction, 0, -1],
        [0, m + M, -m * X, 0, -1, -1, 0],
        [m * Z, -m * X, I + m * (X * X + Z * Z), 0, w - friction * R, 0, 0],
        [0, 0, 0, J, 0, 0, R],
        [0, 1, -w, 0, 0, 0, 0],
    ]
    right = [0.0, -(m + M) * G, m * G * X, 0.0, 0.0, 0.0, 0.0]
    rolls = [[0, 1, 0, 0, 0, 0, 0], [1, 0, 0, -R, 0, 0, 0]]
    lifts = [[0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0, 1]]
    *_, load, needed = np.linalg.solve(balance + rolls, right)
    return friction * load - abs(needed), np.linalg.solve(balance + lifts, right)[1]


def test_a_bicycle_that_may_roll_as_well_as_lift_has_a_code():
    """Just above mu h = w - b the rear wheel of the benchmark bicycle may roll, since its friction brakes it,
    or lift.
    """
    own, limit = braking(measured_bicycle("Benchmark").values)
    friction = limit * jnp.array([0.999, 1.001, 1.003])
    may = np.array([grip_and_lift(own, mu) for mu in friction]) > 0
    assert may.tolist() == [[True, False], [True, True], [False, True]]

    def stopping(friction):
        scene = Braking(**own | {"friction": friction})
        start = {"z": scene.rear, "x_rate": 6.0, "turn_rate": 6.0 / scene.rear}
        motion = jj.simulate(scene, start, ts=[0.1], rtol=1e-9, atol=1e-9)
        return motion.result, motion.phase("rear")[0]

    result, rear = jax.vmap(stopping)(friction)
    assert result.tolist() == [SUCCESS, AMBIGUOUS, SUCCESS]
    assert [rear[0], rear[2]] == [1, 0]
