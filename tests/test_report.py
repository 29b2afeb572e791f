"""The report says what the paper says of its examples, and what it does not say."""

import json

import pytest

import jourdain_jax as jj
from jourdain_jax.analysis.report import report
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
