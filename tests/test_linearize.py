"""Linearisation on the constraint manifold, and families of steady motions: against published bicycles and
closed forms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import with_value
from linkages import SliderCrank
from numpy.testing import assert_allclose, assert_array_equal
from oracles import rolling_disc, whipple_bicycle
from refusals import refused
from small_scenes import DrivenPendulum, HoopBead, OnLine, Twice
from tolerances import LINEARIZATION, ROUND_OFF, relative_error

import jourdain_jax as jj
from jourdain_jax import linearize
from jourdain_jax.bicycle import PARAMETER_NAMES, linear_matrices, measured_bicycle, stability_speeds
from jourdain_jax.models import DoublePendulumAngles, FreeRigidBody, TiltingDisc, WhippleBicycle
from jourdain_jax.studies import Normal

# Linearisation on the constraint manifold, against published bicycles, closed forms, and what a state that is
# not steady must show.


SPEEDS = np.arange(11.0)
CIRCLE = {"lean": 0.3, "yaw_rate": 2.0, "spin_rate": -3.0}  # near a steady circle of a disc
DISC = {"mass": 1.0, "radius": 0.5, "gravity": 9.81}


def _running(bicycle, speed, **values):
    return jj.consistent(bicycle, 0.0, *bicycle.named(**{**bicycle.upright(speed), **values})[:2])


@pytest.fixture(scope="module")
def bicycles():
    """The benchmark bicycle linearised at v = 0, 1 ... 10 m/s, one after the other: a batch of them would be
    compiled for one use.
    """
    bicycle = WhippleBicycle()
    found = [
        linearize(bicycle, _running(bicycle, v), ("lean", "steer"), dependent=("pitch",)) for v in SPEEDS
    ]
    return jax.tree.map(lambda *x: np.stack(x), *found)


def test_the_nonlinear_bicycle_has_the_published_matrices(bicycles):
    limit = LINEARIZATION
    v = SPEEDS[:, None, None]
    assert relative_error(bicycles.M, np.broadcast_to(whipple_bicycle.M, (11, 2, 2))) < limit
    assert relative_error(bicycles.C, v * whipple_bicycle.C1) < limit
    assert relative_error(bicycles.K, 9.81 * whipple_bicycle.K0 + v**2 * whipple_bicycle.K2) < limit


def test_the_bicycle_is_steady_and_lean_and_steer_are_a_system_of_their_own(bicycles):
    assert jnp.max(bicycles.residual) < ROUND_OFF
    assert jnp.max(bicycles.coupling) < ROUND_OFF
    assert jnp.min(bicycles.pivot) > 0.1


def test_lean_and_steer_torque_act_on_lean_and_steer(bicycles):
    assert bicycles.inputs == ("lean_torque", "steer_torque")
    assert relative_error(bicycles.F, np.broadcast_to(np.eye(2), (11, 2, 2))) < ROUND_OFF


def test_the_dependent_pitch_is_found_without_being_named(at_five):
    assert "pitch" not in at_five.states
    assert len(at_five.states) == 7 + 3


def test_a_passage_through_equilibrium_is_not_steady():
    """A pendulum that swings through the vertical has no acceleration there, but its change."""
    pendulum = DoublePendulumAngles()
    names = pendulum.coordinate_names.entries
    swinging = jj.start(pendulum, **{f"{names[0]}_rate": 1.0})
    small = linearize(pendulum, swinging)
    assert small.acceleration < 1e-12
    assert small.residual > 1.0
    assert linearize(pendulum, {}).residual < 1e-12


def test_upright_spinning_is_stable_beyond_the_classical_threshold():
    disc, threshold = TiltingDisc(**DISC), rolling_disc.spinning_threshold(**DISC)
    for factor, grows in ((0.99, True), (1.01, False)):
        values = linearize(disc, {"yaw_rate": factor * threshold}).state_eigenvalues()
        assert (jnp.max(values.real) > 0.1) == grows


def test_what_couples_the_named_coordinate_to_the_rest_is_reported():
    """Lean alone is no system of its own: the gyroscopic torque of yaw is left out."""
    disc = TiltingDisc(**DISC)
    alone = linearize(disc, {"spin_rate": 4.0}, ("lean",))
    together = linearize(disc, {"spin_rate": 4.0})
    assert together.coordinates == ("yaw", "lean", "spin")
    assert_allclose(alone.coupling, 1.5, rtol=1e-12)  # (C + m a^2) spin, N m s: nothing else is in C
    assert together.coupling == 0.0


def test_a_free_body_spins_stably_about_its_extreme_axes_only():
    """Euler: perturbed rates go with s^2 = -(I2 - I1)(I2 - I3) w^2/(I1 I3) about axis 2; turns are seen from
    the turning body.
    """
    body, rate = FreeRigidBody(), 2.0
    I = [float(body.i1), float(body.i2), float(body.i3)]
    for k, axis in enumerate("xyz"):
        i, j = (k + 1) % 3, (k + 2) % 3
        squared = -(I[k] - I[i]) * (I[k] - I[j]) * rate**2 / (I[i] * I[j])
        small = linearize(body, jj.start(body, **{f"attitude_omega_{axis}": rate}))
        values = small.state_eigenvalues()
        expected = np.sqrt(complex(squared))
        assert np.min(np.abs(values - expected)) < 1e-9
        assert np.min(np.abs(values - 1j * rate)) < 1e-9  # a turned axis of rotation, seen from the body
        assert small.residual < 1e-12


def test_a_prescribed_motion_is_not_steady_while_it_accelerates():
    assert linearize(DrivenPendulum(), {}).residual > 0.1


def test_privileged_speeds_may_be_named_in_any_order():
    disc = TiltingDisc(**DISC)
    circle = jj.steady(disc, CIRCLE, held=("lean", "yaw_rate")).state
    named = (None, "spin_rate yaw_rate lean_rate")
    assert_allclose(
        *(linearize(disc, circle, privileged=speeds).state_eigenvalues() for speeds in named), atol=1e-12
    )


@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_derivatives_pass_through_linearisation(derivative):
    """Of the gravity term -m g a of lean in the radius, and of the gyroscopic one (C + m a^2) spin = 3/2 m
    a^2 spin.
    """

    def terms(radius):
        disc = TiltingDisc(**{**DISC, "radius": radius})
        small = linearize(
            disc,
            jj.consistent(disc, 0.0, *disc.named(spin_rate=4.0, x_rate=4.0 * radius)[:2]),
            ("yaw", "lean", "spin"),
        )
        return jnp.stack([small.K[1, 1], small.C[1, 0]])

    assert_allclose(jax.jit(derivative(terms))(0.5), [-9.81, -3.0 * 0.5 * 4.0], rtol=ROUND_OFF)


@pytest.mark.parametrize(
    ("asked", "options", "message"),
    [
        (("learn",), {}, "no coordinate `learn` to perturb; did you mean `lean`"),
        (("pitch",), {"dependent": ("pitch",)}, "in `dependent`"),
        (("yaw",), {}, "not all rates of the coordinates `yaw` are privileged"),
        (("lean",), {"privileged": ("lean_rte",)}, "unknown privileged speed"),
        (("lean", "pitch"), {}, "make the given coordinates dependent"),
    ],
)
def test_wrong_names_are_answered_with_valid_ones(asked, options, message):
    bicycle = WhippleBicycle()
    refused(message, linearize, bicycle, _running(bicycle, 5.0), asked, **options)


class TwoSkates(jj.Scene):
    """Two bodies on skates, one turned against the other about a pin at the rear one's front."""

    coordinates = jj.coordinates("x y heading steer")

    def bodies(self, t, q):
        o, moments = 0.0 * q.x, (0.1, 0.2, 0.3)
        ahead = jnp.stack([jnp.cos(q.heading), jnp.sin(q.heading), o])
        at = jnp.stack([q.x, q.y, o])
        front = jj.RigidBody(1.0, moments, at + ahead, jj.rot_z(q.heading + q.steer))
        return {"rear": jj.RigidBody(2.0, moments, at, jj.rot_z(q.heading)), "front": front}

    def velocity_constraints(self, motion):
        return {name: body.orientation[:, 1] @ body.velocity for name, body in motion.bodies.items()}


def test_speeds_are_chosen_at_the_state_where_those_of_the_domain_do_not_serve():
    scene = TwoSkates()
    state = jj.start(scene, heading=np.pi / 2, x_rate=0.0, y_rate=1.0)
    small = linearize(scene, state, ())
    assert small.pivot > 0.02
    # straight ahead at 1 m/s with both skates in line: a heading stays, a steer of the front one falls
    # as exp(-t), an offset and the speed stay
    assert_allclose(small.state_eigenvalues().real, [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-6)
    in_jit = jax.jit(lambda u: linearize(scene, jj.consistent(scene, 0.0, state.q, u), ()))(state.u)
    assert in_jit.pivot < 1e-12
    assert in_jit.code == 6
    assert np.isnan(in_jit.A).all()
    refused(
        "are not determined by its constraints at this state",
        linearize,
        scene,
        state,
        (),
        privileged=("heading_rate", "steer_rate"),
    )


# Families of steady motions: whole curves, their special points, stability; digits from independent equations
# (Newton-Euler in the turning frame).


NAMES = ("lean", "steer", "pitch", "yaw_rate", "rear_spin_rate", "front_spin_rate")
FIRST_HALF = {
    0.1: (0.029108418746, 0.000225908884, 0.163649429132, 19.992685363213, 17.144262359656),
    0.4: (0.162268296301, 0.004456954662, 0.854379503493, 17.191526326526, 14.976429620126),
}
SECOND_HALF = {
    0.4: (0.297819270847, 0.006882298771, 1.205454357838, 12.954777370022, 11.727228530998),
    0.1: (0.996950578614, 0.007853261055, 1.268104999035, 2.991071968509, 4.723275315848),
}
WEAVE, CAPSIZE, DOUBLE = 4.292382536341, 6.024262015388, 0.684283078892  # m/s


@pytest.fixture(scope="module")
def bicycle():
    return WhippleBicycle()


@pytest.fixture(scope="module")
def turns(bicycle):
    return jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})


@pytest.fixture(scope="module")
def straight(bicycle, turns):
    return jj.family(bicycle, turns.branches[-1])


def magnitudes(point):
    return np.abs([point[name] for name in NAMES])


def test_hands_free_turns_are_one_closed_curve_with_every_digit(turns):
    assert turns.ends == ("the curve is closed",) * 2
    for lean in (0.1, 0.4):
        points = sorted(turns.at(lean=lean), key=lambda point: -point["rear_spin_rate"])
        assert len(points) == 4  # two ways of turning, forward and backward
        for point, expected in zip(
            points, (FIRST_HALF[lean], SECOND_HALF[lean], SECOND_HALF[lean], FIRST_HALF[lean]), strict=True
        ):
            assert_allclose(magnitudes(point), (lean, *expected), rtol=0, atol=2e-11)
            assert point.state.residual < 1e-10


def test_folds_and_rest_of_the_turns(turns):
    first = turns.folds[0]
    assert first.kind == "fold in lean"
    assert_allclose(magnitudes(first)[[0, 2, 3]], (0.420089250821, 0.005834627, 1.043780887), atol=2e-9)
    assert_allclose(magnitudes(first)[[1, 4, 5]], (0.218993988, 15.321918729, 13.533293415), atol=1e-7)
    rest = turns.folds[1]
    assert_allclose(magnitudes(rest), (0, 1.339739911491, 0.007806882108, 0, 0, 0), atol=1e-9)


def test_the_third_family_runs_through_its_fold_to_the_other_side(bicycle):
    found = jj.family(
        bicycle,
        {"lean": 0.9, "steer": 0.25, "yaw_rate": -2.57, "rear_spin_rate": 22.2, "front_spin_rate": 20.6},
    )
    expected = (0.9, 0.253265658718, 0.005858374011, 2.569920264555, 22.179528967864, 20.642557477777)
    assert_allclose(magnitudes(*found.at(lean=0.9)), expected, atol=1e-10)
    assert min(abs(abs(fold["lean"]) - 0.4811) for fold in found.folds if fold.kind == "fold in lean") < 5e-5
    assert abs(np.max(np.abs(found["steer"])) - 2.635) < 2e-3
    assert "without bound" in found.ends[0] + found.ends[1]


def test_straight_running_crosses_the_turns_at_the_capsize_speed(turns, straight):
    for family in (turns, straight):
        assert sorted(point["x_rate"] for point in family.branches) == pytest.approx(
            [-CAPSIZE, CAPSIZE], abs=1e-9
        )
    assert not any(point.differentiable for point in straight.branches)


def test_speeds_of_the_modes_are_the_published_ones(straight):
    changes = {
        (point.kind, name): point["x_rate"]
        for point in straight.changes
        for name in point.modes
        if point["x_rate"] > 0
    }
    which = ("pair on the imaginary axis", "weave"), ("zero eigenvalue", "capsize"), ("double root", "weave")
    assert_allclose([changes[one] for one in which], (WEAVE, CAPSIZE, DOUBLE), atol=1e-9)
    speeds = straight["x_rate"]
    stable = (speeds > WEAVE) & (speeds < CAPSIZE)
    assert stable.any()
    assert_array_equal(straight.stable, stable)


def test_columns_are_those_of_the_modes(straight, bicycle):
    (point,) = straight.at(x_rate=5.0)
    found = dict(zip(straight.mode_names, point.eigenvalues, strict=True))
    real = [found[mode].real for mode in ("castering", "capsize", "weave")]
    assert_allclose(real, (-14.0783896927982, -0.322866429004087, -0.775341882195845), atol=1e-9)
    small = jj.linearize(bicycle, point.state, ("lean", "steer"))
    assert_allclose(np.sort_complex(point.eigenvalues), np.sort_complex(small.eigenvalues()), atol=1e-9)


def test_a_slow_start_does_not_misname_what_passes_zero_at_the_capsize_speed():
    """Castering and capsize of this bicycle are a pair at 1.7 m/s."""
    slow = jj.family(
        measured_bicycle("Browser").scene, {"rear_spin_rate": 5.0}, until={"rear_spin_rate": 35.0}
    )
    assert [point.modes for point in slow.changes if point.kind == "zero eigenvalue"] == [("capsize",)]


def test_the_same_turn_ridden_backward_has_opposite_eigenvalues(turns):
    forward, backward = (
        sorted(turns.at(lean=0.3), key=lambda point: point["rear_spin_rate"])[k] for k in (3, 0)
    )
    assert_allclose(np.sort_complex(backward.eigenvalues), np.sort_complex(-forward.eigenvalues), atol=1e-8)


def test_turns_from_the_capsize_point_on_are_unstable_by_a_real_eigenvalue(turns):
    for lean, which, growth in ((0.1927, -1, 0.0618), (0.3658, -1, 0.3335), (0.4186, -2, 0.994)):
        point = sorted(turns.at(lean=lean), key=lambda point: point["rear_spin_rate"])[which]
        real = point.eigenvalues[point.eigenvalues.imag == 0].real
        assert np.max(real) == pytest.approx(growth, abs=0.02)


def test_an_upright_disc_is_stable_above_its_critical_spin():
    disc = TiltingDisc()
    found = jj.family(disc, {"spin_rate": -4.0}, held="lean", until={"spin_rate": -0.5})
    (change,) = found.changes
    assert change.kind == "double root"
    assert change["spin_rate"] == pytest.approx(-np.sqrt(9.81 / (3 * 0.5)), abs=1e-9)
    assert_array_equal(found.stable, found["spin_rate"] < change["spin_rate"])


def test_steady_turns_of_a_disc_meet_their_closed_form():
    found = jj.family(TiltingDisc(), CIRCLE, held="lean", until={"yaw_rate": 6.0})
    assert_allclose(
        found["spin_rate"],
        -rolling_disc.steady_circle(np.pi / 2 + 0.3, found["yaw_rate"], **DISC)["spin_rate"],
        atol=1e-9,
    )


def hanging():
    """The bottom of the hoop at rates up to 6 rad/s."""
    return jj.family(HoopBead(), {"angle": 0.0}, vary="turning", until={"turning": 6.0})


def test_a_bead_on_a_turning_hoop_leaves_the_bottom_at_a_pitchfork():
    bottom = hanging()
    (branch,) = bottom.branches
    critical = np.sqrt(9.81 / 0.5)
    assert branch["turning"] == pytest.approx(critical, abs=1e-9)
    assert bottom["turning"][-1] == pytest.approx(6.0, abs=1e-9)
    assert_array_equal(bottom.stable, bottom["turning"] < critical)
    aside = jj.family(HoopBead(), branch, vary="turning", until={"turning": 8.0})
    assert_allclose(np.cos(aside["angle"]), 9.81 / (aside["turning"] ** 2 * 0.5), atol=1e-9)
    both = jj.family(HoopBead(), branch, vary="turning")
    assert both["angle"].min() < -1.5
    assert both["angle"].max() > 1.5
    assert {point.kind for point in both.special} == {"branch point", "fold in turning"}
    assert [point["turning"] for point in both.special] == pytest.approx([critical] * 2, abs=1e-9)


@pytest.mark.parametrize("until", [{"radius": -0.5}, None])
def test_a_family_along_a_parameter_ends_where_this_leaves_the_sign_declared_for_it(until):
    found = jj.family(HoopBead(turning=1.0), {"angle": 0.0}, vary="radius", until=until)
    assert 0 < found["radius"].min() < 0.1
    assert any("`radius` is declared positive" in end for end in found.ends)


class SplineBead(HoopBead):
    """The bead with a field of many numbers, which is not a parameter, before the one that varies."""

    weight: jj.Spline = jj.Spline(np.linspace(0.0, 1.0, 5), np.full(5, 9.81))
    pace: float = jj.parameter(3.0, unit="rad/s")

    def bodies(self, t, q):
        return HoopBead(self.radius, self.pace).bodies(t, q)

    def loads(self, motion):
        return jj.gravity(motion, self.weight(0.5))


def test_the_parameter_that_varies_is_found_among_other_numbers_of_a_scene():
    (branch,) = jj.family(SplineBead(), {"angle": 0.0}, vary="pace", until={"pace": 6.0}).branches
    assert branch["pace"] == pytest.approx(np.sqrt(9.81 / 0.5), abs=1e-9)


def test_a_family_in_arrays_and_in_text(turns):
    found = turns.to_xarray()
    assert dict(found.sizes) == {"point": len(turns), "mode": 4}
    assert_array_equal(found["lean"], turns["lean"])
    text = str(turns)
    assert "the curve is closed" in text
    assert "fold in lean" in text
    assert "castering" in text


def test_a_family_is_drawn_against_its_own_values(turns, straight):
    _, (axis,) = jj.plot(turns, "x_rate", "lean", units={"lean": "deg"})
    assert (axis.get_xlabel(), axis.get_ylabel()) == (r"$\dot{x}$ in m/s", "lean in deg")
    assert max(axis.lines[0].get_ydata()) == pytest.approx(np.rad2deg(0.4200892), abs=0.2)
    assert {text.get_text() for text in axis.get_legend().get_texts()} == {
        "unstable",
        "fold",
        "branch point",
        "eigenvalues meet or cross",
    }
    stable = jj.plot(straight, "x_rate", "rear_spin_rate")[1][0].lines[1].get_ydata()
    assert np.isfinite(stable).sum() == straight.stable.sum() > 0
    refused("got 1 names", jj.plot, turns, "lean")


@pytest.mark.parametrize(
    ("guess", "options", "says"),
    [
        (CIRCLE, {}, "2 freedoms.*name 1 of `lean`.*`held`"),
        ({"leen": 0.3}, {}, "did you mean `lean`"),
        ({"lean": 0.3}, {"vary": "radios"}, "did you mean `radius`"),
        ({"lean": 0.3}, {"until": {"x": 1.0}}, "`x` is not an unknown"),
        (CIRCLE, {"held": "lean", "names": ("one",)}, "expected one for each of the 2 modes"),
        ({"lean": float("nan")}, {}, "undefined near the guess"),
        (
            {"spin_rate": -4.0},
            {"held": "lean", "until": {"spin_rate": float("nan")}},
            "`until` of `spin_rate` is nan, expected a finite",
        ),
        (
            {"spin_rate": -4.0},
            {"held": "lean", "until": {"spin_rate": "far"}},
            "`until` of `spin_rate` is .*expected real numbers",
        ),
    ],
)
def test_what_cannot_be_followed_is_refused(guess, options, says):
    refused(says, jj.family, TiltingDisc(), guess, **options)


def test_a_motion_that_stands_alone_and_points_that_are_no_branch_points(turns, bicycle):
    refused("is isolated", jj.family, HoopBead(), {"angle": 0.0})
    refused("expected a branch point", jj.family, bicycle, turns.folds[0])
    refused("expected two axes", jj.stability_chart, bicycle, {"c": (0.02, 0.12)})
    refused(
        r"`prior` is .*expected a dictionary of `jj.studies.Normal",
        jj.stability_chart,
        bicycle,
        {"c": (0.02, 0.12), "rear_spin_rate": (9.0, 10.0)},
        prior={"w": 0.1},
        points=3,
    )
    refused("one name with its value", turns.at, lean=0.1, steer=0.1)
    with pytest.raises(KeyError, match="did you mean `lean`"):
        turns["leam"]


@pytest.fixture(scope="module")
def at_five(bicycle):
    return linearize(bicycle, _running(bicycle, 5.0), ("lean", "steer"))


def test_all_derivatives_of_eigenvalues_are_those_of_the_formulas(at_five):
    weave, capsize = at_five.sensitivities("weave"), at_five.sensitivities("capsize")
    for name, (of_weave, of_capsize, *_) in whipple_bicycle.AT_5.items():
        assert weave[name] == pytest.approx(of_weave, rel=1e-10)
        assert capsize[name] == pytest.approx(of_capsize, rel=1e-10)
    assert weave.held == ("x_rate",)
    assert len(weave.by_parameter) == 26
    assert "12.1856-4.41854i" in str(weave)
    refused("did you mean `weave`", at_five.sensitivities, "weve")


def test_shapes_of_modes_from_both_sides(at_five):
    modes = at_five.modes()
    assert modes.names == ("castering", "weave", "weave", "capsize")
    for s, right, left in zip(modes.eigenvalues, modes.shapes.T, modes.left.T, strict=True):
        P = at_five.M * s**2 + at_five.C * s + at_five.K
        assert_allclose(P @ right, 0.0, atol=1e-9)
        assert np.max(np.abs(right)) == pytest.approx(1.0, abs=1e-12)
        assert_allclose(left.conj() @ P, 0.0, atol=1e-9)
    assert np.all(modes.condition > 0.1)
    assert at_five.modes(("a", "b", "c", "d")).names == ("a", "b", "c", "d")
    with pytest.raises(ValueError, match="expected one for each of the 4 modes"):
        _ = at_five.modes(("a",)).names


def test_a_double_eigenvalue_has_no_derivative(bicycle, straight):
    point = jj.critical(bicycle, straight, "double root")
    small = jj.linearize(bicycle, point.state, ("lean", "steer"))
    found = small.sensitivities("weave")
    assert found.code != 0
    assert found.condition < 1e-6
    assert np.all(np.isnan(list(found.by_parameter.values())))
    assert "special points coincide" in str(found)


def test_the_speed_of_the_double_root_is_the_published_one(bicycle, straight):
    point = jj.critical(bicycle, straight, "double root")
    assert (point.code, point.message) == (0, "found")
    assert point.speed == pytest.approx(DOUBLE, abs=2e-12)
    assert point.eigenvalue.real == pytest.approx(3.78290405129, abs=1e-9)


def test_critical_speeds_are_the_published_ones_and_have_derivatives_by_all_parameters(bicycle, straight):
    for what, speed, k in (("weave", WEAVE, 2), ("capsize", CAPSIZE, 3)):

        def at(scene, what=what):
            point = jj.critical(scene, straight, what)
            return point.speed, point

        by_all, point = jax.jit(jax.grad(at, has_aux=True))(bicycle)
        assert (point.code, point.eigenvalue.real, point.message) == (0, 0.0, "found")
        assert point.speed == pytest.approx(speed, abs=2e-12)
        for name, derivatives in whipple_bicycle.AT_5.items():
            assert getattr(by_all, name) == pytest.approx(derivatives[k], rel=1e-10, abs=1e-10)


def linear_speeds(c):
    return stability_speeds(
        *linear_matrices({name: getattr(WhippleBicycle(), name) for name in PARAMETER_NAMES} | {"c": c})
    )


def test_a_batch_says_which_bicycles_have_no_such_speed(bicycle, straight):
    trails = np.array([0.02, 0.08, 0.3, -0.5, np.nan])
    found = jax.jit(jax.vmap(lambda c: jj.critical(bicycle.replace(c=c), straight, "capsize")))(trails)
    for k, c in enumerate(trails):
        linear = linear_speeds(c)
        assert (found.code[k] == 0) == bool(jnp.isfinite(linear.capsize_speed))
        assert_allclose(found.speed[k], linear.capsize_speed, rtol=1e-9)


def test_a_chart_has_the_speeds_of_stability_as_its_boundaries_and_what_measurements_leave_open(bicycle):
    prior = {"w": Normal(1.02, 0.01), "lam": Normal(0.314, 0.005), "c": Normal(0.08, 1.0)}
    chart = jj.stability_chart(
        bicycle, {"c": (0.04, 0.12), "rear_spin_rate": (5.0, 35.0)}, points=3, prior=prior
    )
    linear = linear_speeds(0.12)
    assert_allclose(
        [curve.speed[2] for _, curve in chart.boundaries],
        [linear.weave_speed, linear.capsize_speed],
        rtol=1e-12,
    )
    slopes = np.array([whipple_bicycle.AT_5["w"][2:], whipple_bicycle.AT_5["lam"][2:]])
    assert_allclose(
        [band[1] for band in chart.bands], np.hypot(0.01 * slopes[0], 0.005 * slopes[1]) / 0.3, rtol=1e-9
    )
    assert (
        str(chart)
        == "weave, pair on the imaginary axis: 3 of 3 found\ncapsize, zero eigenvalue: 3 of 3 found"
    )


@pytest.mark.parametrize("place", [0.0123, 0.05, 0.0877])
@pytest.mark.parametrize(
    ("damped", "kind"), [(1.0, "fold in push"), (1.0, "zero eigenvalue"), (0.0, "pair on the imaginary axis")]
)
def test_two_special_points_a_hundredth_of_a_step_apart_are_found(place, damped, kind):
    for apart, expected in ((1e-6, [-5e-4, 5e-4]), (-1e-6, [])):
        scene = Twice(place=place, apart=apart, damped=damped)
        found = jj.family(scene, {"x": -0.45}, vary="push", until={"push": 0.6}).special
        assert_allclose([point["x"] - place for point in found if point.kind == kind], expected, atol=1e-7)


class Fluttering(OnLine):
    """A particle on a stiffening spring under a constant push, with a drag and a gain that feeds its speed
    back.
    """

    gain: float = jj.parameter(0.5)
    drag: float = jj.parameter(1.0)
    stiffness: float = jj.parameter(4.0)

    def loads(self, motion):
        force = (self.gain - self.drag) * motion.u.x_rate - self.stiffness * motion.q.x - motion.q.x**3 + 1.0
        return jj.generalized_force(motion, x_rate=force)


def frequency(stiffness):
    """Of small motions about the equilibrium without damping, of a unit mass."""
    x = 0.2
    for _ in range(5):
        x = x - (stiffness * x + x**3 - 1.0) / (stiffness + 3 * x**2)
    return jnp.sqrt(stiffness + 3 * x**2)


def test_critical_points_along_a_parameter_have_derivatives_of_both_orders():
    curve = jj.family(Fluttering(), {"x": 0.2}, vary="gain", until={"gain": 3.0})
    critical = lambda drag, stiffness: jj.critical(
        Fluttering(drag=drag, stiffness=stiffness), curve, "pair on the imaginary axis"
    )
    slopes, gain = with_value(jax.grad, lambda x: critical(*x)["gain"])(jnp.array([1.5, 5.0]))
    assert_allclose(gain, 1.5, rtol=1e-12)
    assert_allclose(slopes, [1.0, 0.0], atol=1e-11)
    of_stiffness = jax.jit(jax.hessian(lambda k: critical(1.5, k).eigenvalue.imag))(5.0)
    assert_allclose(of_stiffness, jax.jit(jax.hessian(frequency))(5.0), rtol=1e-9)


def test_points_that_meet_are_no_functions_of_parameters():
    """The bead's pair meets where its equilibria branch: any asymmetry takes this point away."""
    bottom = hanging()
    point = jj.critical(HoopBead(radius=0.8), bottom, "double root")
    assert point.code != 0
    assert np.isnan(point["turning"])


def test_critical_points_that_are_not_there_are_refused(bicycle, straight):
    refused(r"no such special point; it has: .*weave", jj.critical, bicycle, straight, "fold in lean")
    refused("the family belongs to `WhippleBicycle`", jj.critical, TiltingDisc(), straight, "weave")


def test_critical_points_in_float32_are_refused(bicycle, straight):
    with jax.enable_x64(False), pytest.raises(ValueError, match="need float64; set"):
        jj.critical(bicycle, straight, "weave")


def test_a_family_passes_a_loss_of_rank_and_says_that_others_begin_there():
    """Where crank and rod stand upright: the equations are undefined at this very point."""
    found = jj.family(SliderCrank(), {"a": 0.2, "b": -0.2, "x": 1.96}, until={"a": 3.0})
    assert_allclose(found["x"], 2 * np.cos(found["a"]), atol=1e-9)
    assert [point.kind for point in found.special] == ["branch point, before this point"]


def test_families_are_no_functions_to_be_traced(bicycle):
    with pytest.raises(jj.DifferentiationModeError, match="`family` was called inside jit"):
        jax.jit(lambda w: jj.family(bicycle.replace(w=w), {"rear_spin_rate": 20.0}).points[0].z)(1.02)
