"""Which rows are holonomic: Frobenius row by row, and the growth of the admissible velocities."""

import pytest
import small_scenes as small

from jourdain_jax.analysis.integrability import growth_vector, row_integrability
from jourdain_jax.models import (
    BallOnTurntable,
    ChaplyginSleigh,
    DoublePendulumAngles,
    DoublePendulumRods,
    HeisenbergParticle,
    IsokineticParticle,
    TiltingDiscQuaternion,
    TwoWheelAxleFree,
    TwoWheelAxleQuasi,
    VerticalDisc,
)


def test_of_the_two_wheel_axle_six_rows_are_integrable_and_the_four_rolling_rows_are_not():
    found = row_integrability(TwoWheelAxleFree())
    assert found.nonholonomic_rows == ("wheel1 slip[0]", "wheel1 slip[1]", "wheel2 slip[0]", "wheel2 slip[1]")
    assert len(found.integrable_rows) == 6
    assert max(found.violations[row] for row in found.integrable_rows) < 1e-14
    assert min(found.violations[row] for row in found.nonholonomic_rows) > 0.01


def test_rods_are_holonomic():
    found = row_integrability(DoublePendulumRods())
    assert not found.nonholonomic_rows
    assert len(found.integrable_rows) == 2


def test_with_a_quaternion_the_height_of_a_disc_is_holonomic_and_its_rolling_is_not():
    found = row_integrability(TiltingDiscQuaternion())
    assert found.integrable_rows == ("rim height",)
    assert found.nonholonomic_rows == ("rim slip[0]", "rim slip[1]")


def test_a_row_that_keeps_a_speed_is_no_differential_form():
    found = row_integrability(IsokineticParticle())
    assert found.violations == {"constant speed": float("inf")}
    assert found.nonholonomic_rows == ("constant speed",)


def test_an_affine_row_with_an_integrating_factor_is_holonomic():
    assert row_integrability(small.AffineRows()).nonholonomic_rows == ()


def test_a_row_that_is_nearly_holonomic_is_found_not_to_be():
    weak, weaker = (row_integrability(small.AffineRows(strength=s)) for s in (1e-3, 1e-6))
    assert weak.nonholonomic_rows == ("sheet",)
    assert weaker.nonholonomic_rows == ("sheet",)
    # the violation is of first order in the strength
    assert weak.violations["sheet"] / weaker.violations["sheet"] == pytest.approx(1e3, rel=1e-2)


@pytest.mark.parametrize(
    ("scene", "vector"),
    [
        (HeisenbergParticle(), (2, 3)),
        (ChaplyginSleigh(), (2, 3)),
        (VerticalDisc(), (2, 3, 4)),
        (BallOnTurntable(), (3, 5)),
        (TwoWheelAxleFree(), (2, 3, 4)),
        (TwoWheelAxleQuasi(), (2, 3, 4)),
        (TiltingDiscQuaternion(), (3, 4, 5)),
        (DoublePendulumRods(), (2,)),
        (DoublePendulumAngles(), (2,)),
    ],
    ids=lambda x: type(x).__name__ if not isinstance(x, tuple) else "",
)
def test_brackets_of_admissible_velocities_reach_the_known_dimensions(scene, vector):
    found = growth_vector(scene)
    assert found.vector == vector
    assert found.closed


def test_eight_of_the_ten_rows_of_the_axle_are_holonomic_taken_together():
    assert growth_vector(TwoWheelAxleFree()).holonomic_rows_together == 8


def test_a_growth_vector_is_closed_only_where_the_brackets_bring_nothing_new():
    shallow, deep = growth_vector(small.Goursat()), growth_vector(small.Goursat(), depth=5)
    assert shallow.vector == (2, 3, 4, 5)
    assert not shallow.closed
    assert shallow.holonomic_rows_together is None
    assert deep.vector == (2, 3, 4, 5, 6)
    assert deep.closed
    assert deep.holonomic_rows_together == 0


def test_affine_rows_that_are_holonomic_leave_a_line():
    found = growth_vector(small.AffineRows())
    assert found.vector == (1,)
    assert found.holonomic_rows_together == 2


def test_the_drift_of_affine_rows_takes_part_in_the_brackets():
    # fields d/dz and d/dt - x d/dx - s z x d/dy: their bracket is -s x d/dy
    found = growth_vector(small.AffineRows(strength=1.0))
    assert found.vector == (1, 2)
    assert found.closed
    assert found.holonomic_rows_together == 1


def test_nonlinear_rows_have_no_growth_vector():
    found = growth_vector(IsokineticParticle())
    assert found.vector == ()
    assert not found.closed
