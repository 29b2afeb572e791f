"""Which rows are holonomic: Frobenius row by row, and the growth of the admissible velocities; cyclic and
ignorable coordinates.
"""

import numpy as np
import pytest
from small_scenes import AffineRows, Goursat

import jourdain_jax as jj
from jourdain_jax import models
from jourdain_jax.dynamics.reduced import cyclic_coordinates, ignorable_coordinates

FACTS = [
    (models.HeisenbergParticle(), {"growth_vector": (2, 3)}),
    (
        models.ChaplyginSleigh(),
        {"growth_vector": (2, 3), "cyclic_coordinates": (), "ignorable_coordinates": ("x", "y")},
    ),
    (models.VerticalDisc(), {"growth_vector": (2, 3, 4)}),
    (models.BallOnTurntable(), {"growth_vector": (3, 5)}),
    (
        models.TwoWheelAxleQuasi(),
        {"growth_vector": (2, 3, 4), "cyclic_coordinates": ("x1", "y1", "x2", "y2", "psi2")},
    ),
    (
        models.TiltingDiscQuaternion(),
        {
            "growth_vector": (3, 4, 5),
            "integrable_rows": ("rim height",),
            "nonholonomic_rows": ("rim slip[0]", "rim slip[1]"),
        },
    ),
    (
        models.TiltingDisc(),
        {"cyclic_coordinates": ("x", "y"), "ignorable_coordinates": ("x", "y", "yaw", "spin")},
    ),
    (
        models.DoublePendulumRods(),
        {"growth_vector": (2,), "integrable_rows": ("upper rod", "lower rod"), "nonholonomic_rows": ()},
    ),
    (models.Suslov(), {"cyclic_coordinates": (), "ignorable_coordinates": ("attitude",)}),  # as a whole
    # a row that keeps a speed is no differential form, and has no growth vector
    (
        models.IsokineticParticle(),
        {
            "frobenius_violations": {"constant speed": np.inf},
            "nonholonomic_rows": ("constant speed",),
            "growth_vector": (),
        },
    ),
    # an affine row with an integrating factor is holonomic: rows leave a line
    (AffineRows(), {"nonholonomic_rows": (), "growth_vector": (1,), "holonomic_rows_together": 2}),
    # fields d/dz and d/dt - x d/dx - s z x d/dy: their bracket is -s x d/dy
    (AffineRows(strength=1.0), {"growth_vector": (1, 2), "holonomic_rows_together": 1}),
    # one new direction with each bracket, of which four are taken
    (Goursat(), {"growth_vector": (2, 3, 4, 5), "closed": False, "holonomic_rows_together": None}),
]


@pytest.mark.parametrize(("scene", "facts"), FACTS, ids=[type(scene).__name__ for scene, _ in FACTS])
def test_the_report_knows_what_kind_of_system_it_is(scene, facts):
    found = jj.report(scene)
    if "growth_vector" in facts:
        facts = {"closed": bool(facts["growth_vector"])} | facts
    assert {name: getattr(found, name) for name in facts} == facts


def test_a_row_that_is_nearly_holonomic_is_found_not_to_be():
    weak, weaker = (jj.report(AffineRows(strength=s)) for s in (1e-3, 1e-6))
    assert weak.nonholonomic_rows == weaker.nonholonomic_rows == ("sheet",)
    # the violation is of first order in the strength
    assert weak.frobenius_violations["sheet"] / weaker.frobenius_violations["sheet"] == pytest.approx(
        1e3, rel=1e-2
    )


def test_a_bicycle_ignores_its_place_its_heading_and_the_turns_of_its_wheels():
    bicycle = models.WhippleBicycle()
    assert ignorable_coordinates(bicycle) == ("x", "y", "yaw", "rear_spin", "front_spin")
    assert cyclic_coordinates(bicycle) == ("x", "y", "rear_spin")
