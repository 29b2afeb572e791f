"""The report says what the paper says of its examples, and what it does not say."""

import functools
import html
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import OnLine, OnPlane, name_of

import jourdain_jax as jj
from jourdain_jax import report
from jourdain_jax.analysis import Verification
from jourdain_jax.models import (
    ChaplyginSleigh,
    IsokineticParticle,
    Skate,
    Snakeboard,
    TiltingDisc,
    TrailerChain,
    TwoWheelAxleFree,
)


def words(found):
    """What is printed, on one line."""
    return " ".join(str(found).split())


class SkateTwice(Skate):
    """The row of the edge stated twice: by the body and by the coordinates."""

    def velocity_constraints(self, motion):
        heading = motion.q.heading
        sideways = motion.u.y_rate * jj.rot_z(heading)[0, 0] - motion.u.x_rate * jj.rot_z(heading)[1, 0]
        return {**super().velocity_constraints(motion), "edge again": sideways}


class SteeredFar(Snakeboard):
    """The snakeboard with steering beyond a right angle, where its two rows fall together."""

    domain = {**Snakeboard.domain, "steer": (-2.0, 2.0)}


def test_the_report_on_the_free_axle_says_what_the_paper_says_and_more():
    found = report(TwoWheelAxleFree())
    assert len(found.speeds) == 12
    assert len(found.rows) == 10
    assert found.rank == 10
    assert found.redundant_rows == ()
    assert len(found.integrable_rows) == 6
    assert found.nonholonomic_rows == tuple(f"wheel{k} slip[{i}]" for k in (1, 2) for i in (0, 1))
    assert found.degrees_of_freedom == 2
    assert set(found.cyclic_coordinates) == {"x1", "y1", "x2", "y2", "psi2", "z1", "z2"}
    assert found.growth_vector == (2, 3, 4)
    assert found.closed
    assert found.holonomic_rows_together == 8
    assert not found.rheonomic
    text = words(found)
    for phrase in ("(2, 3, 4), closed", "taken together: 8", "manifold of dimension 4", "freedom 2"):
        assert phrase in text


def test_a_row_stated_twice_is_redundant_and_named():
    assert report(SkateTwice()).redundant_rows == ("edge again",)
    assert report(Skate()).redundant_rows == ()


def test_an_isolated_loss_of_rank_is_seen_at_the_configuration_where_it_happens():
    assert report(Snakeboard()).rank_losses == ()
    found = report(SteeredFar())
    assert "steer = 1.571" in found.rank_losses
    assert found.worst_pivot == 0.0
    assert "steer = 1.571" in str(found)


class Roller(jj.Scene):
    """A roller whose two rims roll on a plane; slip is stated along axes of the plane."""

    coordinates = jj.coordinates("x y heading spin")
    privileged = "spin_rate"

    def bodies(self, t, q):
        turned = jj.rot_z(q.heading) @ jj.rot_y(q.spin)
        return {"roller": jj.RigidBody(1.0, jnp.array([0.1, 0.05, 0.1]), [q.x, q.y, 0.0 * q.x + 0.3], turned)}

    def contacts(self, pose):
        return {
            side: jj.disc_contact(pose["roller"], 0.3, centre=(0.0, y, 0.0))
            for side, y in (("left", 0.5), ("right", -0.5))
        }


def test_rows_that_follow_from_the_others_in_another_way_at_each_configuration_are_counted():
    found = report(Roller())
    assert (len(found.rows), found.rank, found.redundant_rows) == (4, 3, ())
    assert "1 at each configuration, but not the same everywhere" in words(found)


def test_privileged_speeds_may_stand_in_one_text():
    class Free(Drifting):
        coordinates, speeds = jj.coordinates("x y"), None
        privileged = " x_rate  y_rate "

        def coordinate_rates(self, t, q, u):
            return u.array

    assert report(Free()).privileged_velocities == ("x_rate", "y_rate")


class Drifting(OnPlane):
    """A bead that is carried along x and free along y: a relation between coordinates that no row states."""

    speeds = jj.speeds("across")
    domain = {"y": (-1.0, 2.0)}
    conventions = "x along the belt."

    def coordinate_rates(self, t, q, u):
        return jnp.stack([1.0 + 0.0 * u.across, u.across])

    def events(self, motion):
        return {"off the belt": 2.0 - motion.q.y}


class Held(OnLine):
    """A bead that is driven and has no freedom left."""

    def geometric_constraints(self, pose):
        return {"held": pose.q.x - 0.3 * jnp.sin(pose.t)}


def test_relations_that_the_rates_contain_are_no_rows():
    found = report(Drifting())
    assert found.rows == ()
    assert found.growth_vector == (1,)
    assert found.holonomic_rows_together == 0
    assert "taken together" not in str(found)
    assert "(1), closed; the motion stays on a manifold of dimension 1" in words(found)


def test_a_scene_without_freedom_says_so_and_nothing_of_conditioning():
    text = words(report(Held()))
    assert "growth vector (0), no freedom left" in text
    assert "their conditioning nothing to choose, no freedom left" in text


def test_the_report_tells_stop_events_domain_and_conventions():
    found = report(Drifting())
    text = words(found)
    assert "events 1: off the belt" in text
    assert "probed in y -1 to 2; otherwise coordinates -3.2 to 3.2, speeds -1 to 1" in text
    assert "conventions x along the belt." in text
    facts = json.loads(json.dumps(found.as_dict()))
    assert (facts["events"], facts["domain"], facts["conventions"]) == (
        ["off the belt"],
        {"y": [-1.0, 2.0]},
        "x along the belt.",
    )


@pytest.mark.parametrize("scene", [IsokineticParticle(), Skate()], ids=name_of)
def test_the_report_for_machines_has_the_named_fields_and_is_json(scene):
    facts = json.loads(json.dumps(report(scene).as_dict(), allow_nan=False))
    assert set(facts) >= {
        "degrees_of_freedom",
        "rows",
        "rank",
        "redundant_rows",
        "integrable_rows",
        "nonholonomic_rows",
        "growth_vector",
        "cyclic_coordinates",
        "ignorable_coordinates",
        "privileged_velocities",
    }
    assert facts["degrees_of_freedom"] == len(facts["privileged_velocities"])


SLEIGH = ChaplyginSleigh()
RUN = {"t1": 0.2, "ts": np.linspace(0.0, 0.2, 5)}


def test_round_off_is_printed_as_zero():
    state = jj.start(jj.models.DoublePendulumRods(), {"x1": 0.6, "z1": -0.8})
    small = eqx.tree_at(lambda s: (s.q, s.u), state, (state.q.at[0].set(-1.3e-136), state.u.at[1].set(2e-17)))
    assert "x1 = 0," in str(small)
    assert "z1_rate = 0," in str(small)
    tiny = eqx.tree_at(lambda s: (s.q, s.u), state, (1e-30 * state.q, 1e-30 * state.u))
    assert "x1 = 6e-31" in str(tiny)
    still = eqx.tree_at(lambda s: (s.q, s.u), state, (-0.0 * abs(state.q), -0.0 * abs(state.u)))
    assert "-0" not in str(still).split("moved")[0]


@functools.cache
def measured():
    motion = jj.simulate(SLEIGH, {"x_rate": 0.6, "heading_rate": 0.9}, **RUN)
    return jj.Experiment(
        motion.ts,
        {"heading": motion["heading"], "x": motion["x"]},
        0.01,
        start={"x_rate": 0.6, "heading_rate": 0.9},
    )


@functools.cache
def fitted():
    return jj.fit(SLEIGH, measured(), "offset")


RESULTS = {
    "State": (lambda: jj.start(SLEIGH, heading_rate=0.5), "State at t = 0 s: x = 0"),
    "Report": (lambda: jj.report(SLEIGH), "Report on ChaplyginSleigh"),
    "Verification": (
        lambda: Verification("ChaplyginSleigh", (), ()),
        "Verification of ChaplyginSleigh: passed",
    ),
    "Rollout": (
        lambda: jj.rollout(SLEIGH, {"heading_rate": np.array([0.5, 0.6])}, **RUN),
        "Rollout of ChaplyginSleigh: 2 lanes",
    ),
    "Fit": (fitted, "Fit of ChaplyginSleigh: converged"),
    "Estimated": (lambda: fitted()["offset"], f"{SLEIGH.offset:.3g} m, standard error"),
    "Profile": (
        lambda: fitted().profiles(measured())["offset"],
        f"`offset` = {SLEIGH.offset:.3g} m, profile",
    ),
    "Prediction": (lambda: fitted().predict(measured())[0]["x"], "5 samples from 0 to"),
    "ChannelResiduals": (
        lambda: fitted().residual_summary()[0],
        "residuals of `heading` of run 0, in sigmas: 5 samples",
    ),
    "SteadyMotion": (lambda: jj.steady(SLEIGH, {"x_rate": 0.5}, held="x_rate"), "steady motion: residual"),
    "Linearization": (lambda: jj.linearize(SLEIGH, {"x_rate": 0.5}, ()), "Small motions: residual"),
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_shows_its_text_wherever_it_is_shown(name):
    make, begins = RESULTS[name]
    result = make()
    assert type(result).__name__ == name
    assert str(result).startswith(begins)
    assert repr(result) == str(result)
    assert result._repr_html_().startswith(f"<pre>{html.escape(str(result))}</pre>")


def test_a_scene_shows_its_numbers_as_one_writes_them():
    assert (
        repr(ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25))
        == str(ChaplyginSleigh())
        == "ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25)"
    )
    assert str(TrailerChain(trailers=0)).startswith("TrailerChain(trailers=0, car_mass=1, ")
    seen = []
    jax.jit(lambda scene: seen.append(str(scene)))(SLEIGH)
    assert seen == ["ChaplyginSleigh(mass=being traced, inertia=being traced, offset=being traced)"]


def test_a_linearization_prints_its_matrices_by_name_and_its_eigenvalues():
    chain = jj.linearize(TrailerChain(trailers=0), {"forward0": 1.0}, ())
    text = str(chain)
    for part in ("A ", "B ", "forward0", "turn0", "drive", "eigenvalues in 1/s: "):
        assert part in text
    disc = jj.linearize(TiltingDisc(), {"spin_rate": -3.0}, ("lean", "yaw"))
    for part in ("M ", "C ", "K ", "lean", "yaw", "eigenvalues in 1/s: "):
        assert part in str(disc)


def test_printing_a_traced_result_says_its_shapes():
    texts = []

    @jax.jit
    def traced(turning):
        motion = jj.simulate(SLEIGH, {"heading_rate": turning}, **RUN)
        texts.extend([str(motion), motion._repr_html_(), str(jj.start(SLEIGH, heading_rate=turning))])
        return motion.q_end

    traced(0.5)
    assert texts[0].startswith("Trajectory, being traced: ")
    assert "the largest of shape (5, 3); print it outside of `jax.jit`, or use `jax.debug.print`" in texts[0]
    assert texts[1] == f"<pre>{texts[0]}</pre>"
    assert texts[2].startswith("State, being traced: ")
