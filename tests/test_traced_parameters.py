"""Scenes whose parameters are traced by a user's own `jit`, `vmap` or `grad`: the right motion or a code that
says why not, never another structure.

What holds of a scene is found before anything is compiled, at numbers that stand in for traced parameters.
These scenes sit at special values by default, where rows are dependent, a coordinate does not matter, or
nothing does work, and are given generic ones; or the other way round.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import result_codes as results
from numpy.testing import assert_allclose
from refusals import refused
from slopes import slope
from small_scenes import OnPlane, Upright

import jourdain_jax as jj
from jourdain_jax.identification import log_density, planned_information


class TwoBlades(jj.Scene):
    """A plate on two parallel blades, turned by a torque: at one place they are one blade, at two places the
    plate can only slide along.
    """

    mass: float = jj.parameter(1.3, positive=True)
    front: float = jj.parameter(0.3)
    rear: float = jj.parameter(0.3)
    coordinates = jj.coordinates("x y heading")

    def bodies(self, t, q):
        position = jnp.stack([q.x, q.y, 0.0])
        return {"plate": jj.RigidBody(self.mass, 0.4 * jnp.ones(3), position, jj.rot_z(q.heading))}

    def loads(self, motion):
        return jj.generalized_force(motion, heading_rate=0.6)

    def velocity_constraints(self, motion):
        plate = motion["plate"]
        places = {"front": self.front, "rear": self.rear}
        return {
            name: jj.knife_edge(plate, plate.place([a, 0.0, 0.0]), plate.orientation[:, 1])
            for name, a in places.items()
        }


class Slope(OnPlane):
    """A bead on a slope, level by default, where its place does not matter; a side wind, none by default."""

    mass: float = jj.parameter(2.0, positive=True)
    slope: float = jj.parameter(0.0)
    wind: float = jj.parameter(0.0)

    def potential(self, pose):
        return 0.5 * self.mass * 9.81 * self.slope * pose.q.x**2

    def velocity_constraints(self, motion):
        return {"carried": motion.u.y_rate - self.wind * (1.0 + motion.q.x)}


class Hanging(jj.Scene):
    """A pendulum of two rods in a row; none of its parameters has a default."""

    mass: float = jj.parameter(positive=True)
    upper: float = jj.parameter(positive=True)
    lower: float = jj.parameter(positive=True)
    coordinates = jj.coordinates("angle")

    def bodies(self, t, q):
        rod = (self.upper + self.lower) * jnp.stack([jnp.sin(q.angle), 0.0, -jnp.cos(q.angle)])
        return {"bob": jj.Particle(self.mass, rod)}

    def loads(self, motion):
        return jj.gravity(motion, 9.81)


class SmallLoop(Upright):
    """A bead on a small ring, in a domain of the ring's size; its radius has no default."""

    radius: float = jj.parameter(positive=True)
    mass = 0.1
    domain = {"x": (-0.03, 0.03), "z": (-0.03, 0.03)}

    def geometric_constraints(self, pose):
        return {
            "ring": (
                jnp.sqrt(jnp.maximum(0.0025 - pose.q.x**2 - pose.q.z**2, 0.0))
                - jnp.sqrt(0.0025 - self.radius**2)
            )
        }


OPTIONS = {"ts": np.array([0.0, 0.4, 0.8]), "rtol": 1e-10, "atol": 1e-10}


def sliding(**parameters):
    """The end of a motion from speeds that the constraints may change, and its result code."""
    scene = TwoBlades(**parameters)
    start = jj.consistent(scene, 0.0, jnp.array([0.0, 0.0, 0.3]), jnp.array([0.7, 0.4, 0.5]))
    motion = jj.simulate(scene, start, **OPTIONS)
    return motion.q_end, motion.result


class Hung(OnPlane):
    """A mass on a rod from a point, which must lie in its plane."""

    mass: float = jj.parameter(1.3)
    point: object = jj.parameter((0.0, 1.0, 0.0))
    example = {"x": 0.4}

    def loads(self, motion):
        return jj.gravity(motion, 9.81, (0.0, -1.0, 0.0))

    def geometric_constraints(self, pose):
        return {"rod": jj.rod(pose["mass"].position, self.point, 1.0), "level": self.point[2]}


def test_parameters_without_defaults_may_be_traced():
    def end(mass, upper, lower):
        scene = Hanging(mass=mass, upper=upper, lower=lower)
        return jj.simulate(scene, {"angle": 0.4}, **OPTIONS).q_end[0]

    alone = end(0.3, 2.0, 0.5)
    assert_allclose(jax.jit(end)(0.3, 2.0, 0.5), alone, rtol=1e-9)
    assert_allclose(jax.vmap(end)(*(jnp.array([x, 1.0]) for x in (0.3, 2.0, 0.5)))[0], alone, rtol=1e-9)
    along = jax.jit(jax.grad(end, (0, 1, 2)))(0.3, 2.0, 0.5)
    assert_allclose(along[1], along[2], rtol=1e-9)  # only their sum counts
    assert_allclose(along[0], 0.0, atol=1e-9)
    assert_allclose(along[1], slope(lambda upper: end(0.3, upper, 0.5), 2.0), rtol=1e-6)


def test_a_traced_parameter_without_default_that_fits_no_state_of_the_domain_is_refused():
    assert jj.structure_of(SmallLoop(radius=0.02)).rank == 1
    refused(
        "replaced by numbers near their defaults, or near 1 without a default: give defaults near",
        jax.jit(lambda radius: jj.structure_of(SmallLoop(radius=radius)).rank),
        0.02,
    )


def test_defaults_at_which_rows_are_dependent_do_not_decide_for_traced_parameters():
    two_at = lambda front, rear: sliding(front=front, rear=rear)
    q, code = jax.jit(two_at)(0.3, 0.5)
    assert int(code) == results.SUCCESS
    # the one speed that two blades at two places let the plate keep
    forward = 0.7 * np.cos(0.3) + 0.4 * np.sin(0.3)
    assert_allclose(q, [0.8 * forward * np.cos(0.3), 0.8 * forward * np.sin(0.3), 0.3], atol=1e-9)
    many, codes = jax.vmap(two_at)(jnp.array([0.3, 0.1]), jnp.array([0.5, 0.9]))
    assert_allclose(many, np.stack([q, q]), atol=1e-9)
    assert codes.tolist() == [results.SUCCESS] * 2
    assert_allclose(jax.jacrev(lambda *at: two_at(*at)[0], (0, 1))(0.3, 0.5), np.zeros((2, 3)), atol=1e-9)


def test_defaults_at_which_a_coordinate_does_not_matter_do_not_decide_for_traced_parameters():
    def end(slope, wind):
        motion = jj.simulate(Slope(slope=slope, wind=wind), {"x": 0.5}, **OPTIONS)
        return jnp.append(motion.q_end, motion.work[-1])

    rate = np.sqrt(9.81 * 0.7)
    x, y = 0.5 * np.cos(rate * 0.8), 1.3 * (0.8 + 0.5 * np.sin(rate * 0.8) / rate)
    # the wind alone moves the bead across: its work is all of the kinetic energy there
    work = 0.5 * 2.0 * 1.3**2 * ((1 + x) ** 2 - 1.5**2)
    expected = [x, y, work]
    assert_allclose(jax.jit(end)(0.7, 1.3), expected, atol=1e-8)
    assert_allclose(
        jax.vmap(end)(jnp.array([0.7, 0.0]), jnp.array([1.3, 0.0])), [expected, [0.5, 0.0, 0.0]], atol=1e-8
    )
    slopes = jax.jit(jax.jacrev(end, (0, 1)))(0.7, 1.3)
    assert_allclose(slopes[0], slope(lambda slope: end(slope, 1.3), 0.7), atol=1e-5)
    assert_allclose(slopes[1], slope(lambda wind: end(0.7, wind), 1.3), atol=1e-5)


def test_a_program_made_where_rows_do_no_work_is_not_taken_where_they_do():
    still, blown = (jj.simulate(Slope(slope=0.7, wind=wind), {"x": 0.5}, **OPTIONS) for wind in (0.0, 1.3))
    assert still.work is None
    assert "lowered" in blown.reduction
    assert_allclose(blown.work[-1], 0.5 * 2.0 * 1.3**2 * ((1 + blown["x"][-1]) ** 2 - 1.5**2), rtol=1e-8)


def test_a_start_that_is_known_is_put_onto_the_rows_while_other_numbers_are_traced():
    skate = jj.models.Skate()
    start = jj.start(skate, **skate.example)

    def end(t1, start=start, **options):
        return jj.simulate(skate, start, t1=t1, **options).q_end

    within = jax.jit(lambda t1: end(t1, jj.start(skate, **skate.example)))
    of_tolerance = jax.jit(lambda rtol: end(0.5, rtol=rtol, solver=diffrax.Dopri8()))
    for found in (jax.jit(end)(0.5), within(0.5), of_tolerance(1e-10)):
        assert_allclose(found, end(0.5), rtol=1e-7)


def test_parameters_that_no_lane_varies_and_no_fit_frees_keep_their_numbers():
    scene, start = Hung(), {"x": 0.4}
    alone = jj.simulate(scene, start, **OPTIONS)
    lanes = jj.rollout(scene, start, parameters={"mass": jnp.array([1.0, 2.0])}, **OPTIONS).lanes
    assert_allclose(lanes.q, [alone.q, alone.q], atol=1e-8)
    assert jj.diagnose(alone).energy_drift < 1e-8
    x, y, speed = alone["x"], alone["y"] - 1.0, np.hypot(alone["x_rate"], alone["y_rate"])
    pull = 1.3 * (speed**2 - 9.81 * y)  # N, along the rod of 1 m
    force = alone.constraint_forces().forces_on("mass")["rod"]
    assert_allclose(force[:, :2], -pull[:, None] * jnp.stack([x, y], axis=1), atol=1e-7)
    data = [jj.Experiment(OPTIONS["ts"], {"x": alone["x"] + off}, 0.01, start=start) for off in (0.0, 0.02)]
    right, off = (log_density(scene, x, free=("mass",)) for x in data)
    assert_allclose(right(right.initial) - off(off.initial), 3 * 0.5 * 2.0**2, rtol=1e-3)
    assert planned_information(scene, data[0], free=("mass",)).labels == ("mass",)
