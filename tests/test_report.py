"""The report says what the paper says of its examples, and what it does not say."""

import json

import jax.numpy as jnp
import pytest
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj
from jourdain_jax import report
from jourdain_jax.models import IsokineticParticle, Skate, Snakeboard, TwoWheelAxleFree, TwoWheelAxleRedundant


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
    assert (len(found.integrable_rows), len(found.nonholonomic_rows)) == (6, 4)
    assert found.degrees_of_freedom == 2
    assert set(found.cyclic_coordinates) == {"x1", "y1", "x2", "y2", "psi2", "z1", "z2"}
    assert found.growth_vector == (2, 3, 4)
    assert found.closed
    assert found.holonomic_rows_together == 8
    assert not found.rheonomic
    text = " ".join(str(found).split())
    for phrase in ("(2, 3, 4), closed", "taken together: 8", "manifold of dimension 4", "degrees of freedom 2"):
        assert phrase in text


def test_neither_form_of_the_axles_row_may_be_dropped():
    found = report(TwoWheelAxleRedundant())
    assert len(found.rows) == 11
    assert found.rank == 10
    assert not {"axle along x", "axle along y"} & set(found.redundant_rows)


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
        return {"roller": jj.RigidBody(1.0, jnp.array([0.1, 0.05, 0.1]), jnp.stack([q.x, q.y, 0.0 * q.x + 0.3]), turned)}

    def contacts(self, pose):
        return {side: jj.disc_contact(pose["roller"], 0.3, centre=(0.0, y, 0.0)) for side, y in (("left", 0.5), ("right", -0.5))}


def test_rows_that_follow_from_the_others_in_another_way_at_each_configuration_are_counted():
    found = report(Roller())
    assert (len(found.rows), found.rank, found.redundant_rows) == (4, 3, ())
    assert "1 at each configuration, but none at all of them" in " ".join(str(found).split())


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
    assert "(1), closed; the motion stays on a manifold of dimension 1" in " ".join(str(found).split())


def test_a_scene_without_freedom_says_so_and_nothing_of_conditioning():
    text = " ".join(str(report(Held())).split())
    assert "growth vector (0), no freedom left" in text
    assert "their conditioning nothing to choose, no freedom left" in text


def test_the_report_tells_stop_events_domain_and_conventions():
    found = report(Drifting())
    text = " ".join(str(found).split())
    assert "stops at 1: off the belt" in text
    assert "probed in y -1 to 2; otherwise coordinates -3.2 to 3.2, speeds -1 to 1" in text
    assert "conventions x along the belt." in text
    facts = json.loads(json.dumps(found.as_dict()))
    assert (facts["events"], facts["domain"], facts["conventions"]) == (["off the belt"], {"y": [-1.0, 2.0]}, "x along the belt.")


@pytest.mark.parametrize("scene", [IsokineticParticle(), Skate()], ids=lambda s: type(s).__name__)
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
