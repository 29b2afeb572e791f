"""A scene's class is read for misspelt methods, names that do not exist and arguments it does not take,
before anything is computed.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from refusals import refused
from small_scenes import Bead

import jourdain_jax as jj
from jourdain_jax.models import MODELS


def described(**members):
    """The bead with some members added."""
    return type("Described", (Bead,), members)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("velocity_constraint", "velocity_constraints"),
        ("geometric_constaints", "geometric_constraints"),
        ("load", "loads"),
        ("contact", "contacts"),
        ("event", "events"),
        ("potencial", "potential"),
        ("prescribe", "prescribed"),
        ("coordinate_rate", "coordinate_rates"),
        ("invariant", "invariants"),
        ("forces", "loads"),
        ("constraints", "velocity_constraints"),
        ("holonomic_constraints", "geometric_constraints"),
    ],
)
def test_a_method_whose_name_is_misspelt_does_not_drop_physics_silently(name, meant):
    refused(
        (
            f"`Described` has a method `{name}`, which nothing calls; did you mean `{meant}`\\? Rename it, or"
            " begin its name"
        ),
        lambda: described(**{name: lambda self, motion: {}})(),
    )


def test_a_helper_of_a_base_class_may_be_overridden():
    class Pushed(Bead):
        def loads(self, motion):
            return self.forces(motion)

        def forces(self, motion):
            return jj.generalized_force(motion, x_rate=1.0)

    class Pulled(Pushed):
        def forces(self, motion):
            return jj.generalized_force(motion, x_rate=-3.0)

    assert jj.accelerations(Pulled(), 0.0, jnp.zeros(2), jnp.zeros(2)).udot[0] == -3.0


def test_own_methods_parameters_and_helpers_beside_the_real_method_are_left_alone():
    class Own(Bead):
        load: object = jj.parameter(2.0, unit="N")  # a parameter, not a method

        def loads(self, motion):
            return self.loads_of_wind(motion)

        def loads_of_wind(self, motion):
            return jj.generalized_force(motion, x_rate=self.load)

        def contact_arm(self):
            return 1.0

        def velocity_constraints(self, motion):
            return self.holonomic_constraints(motion.u)

        def holonomic_constraints(self, u):
            return {"held": self.torques * u.y_rate}

        @property
        def torques(self):
            return 2.0

        def _event(self):
            return 1.0

        @classmethod
        def potentials(cls):
            return cls()

    assert Own().load == 2.0


def test_a_scene_with_an_init_of_its_own_takes_its_own_arguments():
    class Heavy(Bead):
        def __init__(self, weight):
            self.mass = weight / 9.81

    assert Heavy(weight=9.81).mass == 1.0
    refused(r"scene `Heavy` has no parameter `wait`; .*Valid names: `weight`", Heavy, wait=9.81)


def test_a_text_must_be_a_static_field():
    class Labelled(jj.models.Skate):
        label: object = "blue"

    refused(
        (
            r"field `label` of `Labelled` holds the text 'blue', expected numbers; .*eqx.field\(static=True,"
            r" default='blue'\)"
        ),
        Labelled,
    )


@pytest.mark.parametrize("value", [3, True])
def test_a_count_or_a_switch_must_be_a_static_field(value):
    class Chain(Bead):
        links: object = value

    refused(
        rf"field `links` of `Chain` is {value}, which is not a parameter; .*static=True, default={value}",
        Chain,
    )

    class Static(Bead):
        links: object = eqx.field(static=True, default=value)

    assert Static().links == value


def test_every_model_is_described_rightly_and_no_check_is_in_a_traced_program():
    for model in MODELS.values():
        model()
    plain = jax.make_jaxpr(lambda mass: 2.0 * Bead(mass=mass).mass)(1.0)
    assert {equation.primitive.name for equation in plain.eqns} <= {"convert_element_type", "mul"}
