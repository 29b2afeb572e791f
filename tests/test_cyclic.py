"""Cyclic and ignorable coordinates, and what may be done without them."""

import pytest

from jourdain_jax.dynamics.reduced import cyclic_coordinates, ignorable_coordinates
from jourdain_jax.models import ChaplyginSleigh, Suslov, TiltingDisc, TwoWheelAxleCoordinates, TwoWheelAxleFree, TwoWheelAxleQuasi, WhippleBicycle


def test_positions_and_the_second_wheels_angle_of_the_axle_are_cyclic():
    # Wang and Pao (2003), section VI; as free bodies z1 and z2 too
    assert set(cyclic_coordinates(TwoWheelAxleFree())) == {"x1", "y1", "z1", "x2", "y2", "z2", "psi2"}


@pytest.mark.parametrize("scene", [TwoWheelAxleCoordinates(), TwoWheelAxleQuasi()], ids=lambda s: type(s).__name__)
def test_the_axle_has_the_same_cyclic_coordinates_by_methods_two_and_three(scene):
    assert set(cyclic_coordinates(scene)) == {"x1", "y1", "x2", "y2", "psi2"}


def test_a_disc_does_not_care_where_it_is_nor_how_it_is_turned():
    assert ignorable_coordinates(TiltingDisc()) == ("x", "y", "yaw", "spin")
    assert cyclic_coordinates(TiltingDisc()) == ("x", "y")


def test_the_heading_of_a_sleigh_is_not_cyclic():
    assert cyclic_coordinates(ChaplyginSleigh()) == ()
    assert ignorable_coordinates(ChaplyginSleigh()) == ("x", "y")


def test_a_bicycle_ignores_its_place_its_heading_and_the_turns_of_its_wheels():
    assert ignorable_coordinates(WhippleBicycle()) == ("x", "y", "yaw", "rear_spin", "front_spin")
    assert cyclic_coordinates(WhippleBicycle()) == ("x", "y", "rear_spin")


def test_an_attitude_that_changes_nothing_is_ignorable_as_a_whole_and_not_cyclic():
    assert ignorable_coordinates(Suslov()) == ("attitude",)
    assert cyclic_coordinates(Suslov()) == ()
