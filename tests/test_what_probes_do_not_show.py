"""Programs are judged at probes. What these cannot show, because a branch lies elsewhere or only derivatives
differ, must not be concluded from them.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_scenes import InSpace, OnPlane

import jourdain_jax as jj

KNOTS = np.linspace(-3.0, 3.0, 7)
TIGHT = {"rtol": 1e-9, "atol": 1e-9}


def looked_up(x, table=None):
    return jnp.interp(x, KNOTS, jnp.sin(KNOTS) if table is None else table)


def ends(scene, start):
    """Of the lowered and of the dense motion."""
    return [
        jj.simulate(scene, start, t1=1.0, backend=backend, **TIGHT).q_end for backend in ("auto", "dense")
    ]


class Fading(OnPlane):
    """Two look-ups, one of whose operands leaves the other long after all probes."""

    def loads(self, motion):
        force = lambda x: -looked_up(x)
        x = motion.q.x
        return jj.generalized_force(
            motion, x_rate=force(x), y_rate=force(x * jax.nn.sigmoid((20.0 - motion.t) / 0.1))
        )


class Filtered(OnPlane):
    """Two calls of one kind: what they are given as numbers is the same, the arrays that other calls hand
    them are not.
    """

    def loads(self, motion):
        filtered = lambda x: jax.lax.scan(
            lambda c, k: (jnp.tanh(c + k * x), c), 0.1 * x, jnp.linspace(0.2, 1.0, 40)
        )[1]
        halved = lambda values: jax.lax.while_loop(
            lambda v: jnp.max(v) > 0.1, lambda v: 0.5 * v, values
        ).sum()
        common = 2.0 + jnp.sin(filtered(motion.u.x_rate)[3])
        return jj.generalized_force(
            motion,
            x_rate=-halved(common * filtered(motion.q.x)),
            y_rate=-halved(common * filtered(motion.q.y)),
        )


# operands differ later; three filtered, two halved
@pytest.mark.parametrize(("scene", "count"), [(Fading(), 2), (Filtered(), 5)])
def test_calls_that_differ_later_or_in_what_made_their_operands_stay_apart(scene, count):
    program = jj.lower(scene)
    assert len(program.graph.calls(program.ydot)) == count


class Pushed(OnPlane):
    """Some force along x, often none near the probes."""

    push: Callable = eqx.field(static=True)
    size: object = jj.parameter(1e-10)

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=self.push(motion, self.size))


PUSHES = {
    "switched on": lambda motion, _: jnp.where(motion.t > 2.0, -4.0 * motion.q.x, 0.0),
    "growing": lambda motion, _: -motion.q.x * jnp.maximum(motion.t - 2.0, 0.0),
    "table in time": lambda motion, _: (
        -motion.q.x * jnp.interp(motion.t, jnp.array([0.0, 2.0, 3.0]), jnp.array([0.0, 0.0, 4.0]))
    ),
    "branch elsewhere": lambda motion, _: jnp.where(motion.q.y > 50.0, -4.0 * motion.q.x, 0.0),
    "wall": lambda motion, _: -50.0 * jax.nn.sigmoid((motion.q.x - 5.0) / 0.02),
    "hill": lambda motion, _: jnp.exp(-((motion.q.x - 20.0) ** 2)),
    "tiny by its parameter": lambda motion, size: -size * motion.q.x,
    "chosen by its parameter": lambda motion, size: jnp.where(size > 0.5, -motion.q.x, 0.0),
}


@pytest.mark.parametrize("name", PUSHES)
def test_a_force_that_acts_later_elsewhere_or_for_other_parameters_is_there(name):
    assert "x" not in jj.lower(Pushed(PUSHES[name])).held


def test_a_force_that_sets_in_later_acts_and_one_program_serves_all_parameters():
    later, spring = Pushed(PUSHES["switched on"]), Pushed(PUSHES["tiny by its parameter"])
    assert_allclose(jj.simulate(later, {"x": 1.0}, t1=3.0, **TIGHT).q_end[0], np.cos(2.0), atol=1e-7)
    sizes = {"size": jnp.array([1e-10, 4.0])}
    lanes = jj.rollout(spring, {"x": 1.0}, parameters=sizes, t1=1.0, **TIGHT).lanes
    assert_allclose(lanes.q_end[:, 0], [1.0, np.cos(2.0)], atol=1e-7)


class Ground(InSpace):
    """A particle on ground that is flat, or has a bump far away, or a slope."""

    bump: object = jj.parameter(0.0)
    slope: object = jj.parameter(0.0)
    with_bump: bool = eqx.field(static=True, default=False)

    def geometric_constraints(self, pose):
        x, _, z = pose["mass"].position
        return {
            "ground": z - self.slope * x - (self.bump * jnp.exp(-((x - 6.0) ** 2)) if self.with_bump else 0.0)
        }


@pytest.mark.parametrize("scene", [Ground(slope=0.5), Ground(bump=0.3, with_bump=True)])
def test_states_are_put_back_onto_rows_as_they_are_for_other_parameters_and_elsewhere(scene):
    jj.lower(Ground(with_bump=scene.with_bump))  # built where the ground is flat
    lowered, dense = ends(scene, {"x": 5.5, "x_rate": 1.0})
    assert_allclose(lowered, dense, atol=1e-7)


class Small(OnPlane):
    """Two tables of tiny numbers, one the other with its sign changed."""

    table: object = jj.parameter(1e-11 * np.array([5.0, 3.0, 2.0, 0.0, -2.0, -3.0, -5.0]))
    scale: object = jj.parameter(1e11)

    def loads(self, motion):
        force = lambda table: self.scale * looked_up(motion.q.x, table)
        return jj.generalized_force(motion, x_rate=force(self.table), y_rate=force(-self.table))


def test_operands_are_compared_relative_to_their_size():
    assert_allclose(*ends(Small(), {"x": 1.0}), atol=1e-8)


def test_a_callback_that_knows_no_batches_runs_alone_and_is_refused_by_name_in_batches():
    called = Pushed(
        lambda motion, _: jax.pure_callback(
            lambda x: np.asarray(-np.sin(x)), jax.ShapeDtypeStruct((), motion.q.x.dtype), motion.q.x
        )
    )
    motion = jj.simulate(called, {"x": 1.0}, t1=1.0, formulation=jj.Formulation(stabilisation=None), **TIGHT)
    assert motion.u_end[0] ** 2 / 2 - np.cos(motion.q_end[0]) == pytest.approx(-np.cos(1.0), abs=1e-7)
    with pytest.raises(NotImplementedError, match="vmap"):
        jj.rollout(called, {"x": jnp.array([1.0, 1.1])}, t1=0.1)


class Sorted(OnPlane):
    """A part that is kept only because of what it follows."""

    table: object = jj.parameter(np.linspace(1.0, 2.0, 9))

    def loads(self, motion):
        order = jnp.argsort(self.table)
        factor = jnp.sin(jnp.interp(motion.q.x, jnp.linspace(-3.0, 3.0, 9), self.table**2))
        return jj.generalized_force(motion, x_rate=jnp.take(self.table * factor, order) @ jnp.arange(9.0))


def test_every_call_says_why_it_is_one():
    assert all(jj.lower(Sorted()).calls)
    assert ";  has" not in jj.report(Sorted()).lowering


def test_a_start_that_hardly_depends_on_a_parameter_gives_no_warning(recwarn):
    def end(k):
        scene = Pushed(PUSHES["tiny by its parameter"], size=k)
        return jj.simulate(scene, {"x": 1.0 + 1e-6 * k}, t1=3.0).q_end[0]

    slope = jax.jvp(end, (1.0,), (1.0,))[1]
    assert_allclose(slope, -1.5 * np.sin(3.0) + 1e-6 * np.cos(3.0) - 1.5e-6 * np.sin(3.0), rtol=1e-6)
    assert not [w for w in recwarn if issubclass(w.category, jj.SensitivityWarning)]


def test_tables_are_parameters_and_differ_between_lanes():
    tables = jnp.stack([1e-11 * jnp.array([5.0, 3.0, 2.0, 0.0, -2.0, -3.0, -5.0]) * k for k in (1.0, -2.0)])
    lanes = jj.rollout(Small(), {"x": 1.0}, parameters={"table": tables}, t1=1.0).lanes.q_end
    for end, table in zip(lanes, tables, strict=True):
        assert_allclose(end, jj.simulate(Small(table=table), {"x": 1.0}, t1=1.0).q_end, atol=1e-6)
    assert abs(float(lanes[0, 0] - lanes[1, 0])) > 0.1


# What begins after t = 1, or outside the domain. ------------------------------------------------------------


class LateBelt(OnPlane):
    """A belt that starts to move at t = 2."""

    def velocity_constraints(self, motion):
        return {
            "belt": motion.u.y_rate - motion.u.x_rate - jnp.where(motion.t > 2.0, (motion.t - 2.0) ** 3, 0.0)
        }


class FarBelt(OnPlane):
    """A belt that moves where x > 10."""

    def velocity_constraints(self, motion):
        return {"belt": motion.u.y_rate - motion.u.x_rate - jnp.maximum(motion.q.x - 10.0, 0.0) ** 2}


class LateStiffness(OnPlane):
    """A spring that stiffens from t = 2 on."""

    def loads(self, motion):
        stiffness = 1.0 + 0.5 * jnp.where(motion.t > 2.0, (motion.t - 2.0) ** 2, 0.0)
        return jj.spring(motion["mass"].point(), jj.fixed_point(jnp.zeros(3)), stiffness, 0.5)


class LateMass(OnPlane):
    """Matter joins from t = 2 on."""

    def bodies(self, t, q):
        return {"particle": jj.Particle(1.0 + jnp.maximum(t - 2.0, 0.0) ** 3, [q.x, q.y, 0.0])}

    def loads(self, motion):
        return jj.spring(motion["particle"].point(), jj.fixed_point(jnp.zeros(3)), 1.0, 0.5)


class LateLift(jj.Scene):
    """A wire that is lifted by one metre near t = 3."""

    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        lifted = jnp.exp(-jnp.exp(-40.0 * (t - 3.0)))
        return {"particle": jj.Particle(1.0, [q.x, 0.3 * q.x + lifted, 0.0])}


LATE = [
    (LateBelt(), {"x_rate": 1.0}, 4.0, "homogeneous"),
    (FarBelt(), {"x": 9.5, "x_rate": 1.0}, 2.0, "homogeneous"),
    (LateStiffness(), {"x": 1.0, "y_rate": 0.3}, 4.0, "timed"),
    (LateMass(), {"x": 1.0, "y_rate": 0.3}, 4.0, "varying_inertia"),
    (LateLift(), {"x_rate": 1.0}, 3.5, "driven"),
]


@pytest.mark.parametrize(
    ("scene", "start", "end", "fact"), LATE, ids=[type(case[0]).__name__ for case in LATE]
)
def test_the_work_of_what_begins_late_or_far_off_is_counted(scene, start, end, fact):
    assert bool(getattr(jj.structure_of(scene), fact)) == (fact != "homogeneous")
    motion = jj.simulate(scene, start, ts=np.linspace(0.0, end, 41), rtol=1e-10, atol=1e-10).raise_if_failed()
    changed = float(np.ptp(motion.energies().kinetic + motion.energies().potential))
    assert changed > 0.05
    assert_allclose(motion.energies().balance, motion.energies().balance[0], atol=1e-4 * changed)


class FastRow(OnPlane):
    """A row that is nonlinear in a speed beyond 3 m/s."""

    def velocity_constraints(self, motion):
        v = motion.u.x_rate
        return {"lift": motion.u.y_rate - jnp.where(v > 3.0, (v - 3.0) ** 2, 0.0)}

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=1.0, y_rate=-0.5)


def test_rows_that_are_nonlinear_at_speeds_beyond_the_probed_ones_hold():
    for backend in ("auto", "dense"):
        motion = jj.simulate(FastRow(), {"x_rate": 4.0}, t1=2.0, backend=backend).raise_if_failed()
        assert_allclose(
            motion.u_end, [4.0, 1.0], atol=1e-8
        )  # (1 + 4 (v-3)^2) vdot = 1 - (v-3), at rest where v = 4


class Terrain(OnPlane):
    """Branches that neither time nor speeds decide: nothing begins that is not there."""

    def velocity_constraints(self, motion):
        slope = jnp.where(motion.q.x > 0.0, jnp.tanh(motion.q.x), 0.0)
        return {"ground": motion.u.y_rate - slope * motion.u.x_rate}

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=-jnp.maximum(motion.q.x, 0.0))


def test_branches_of_coordinates_alone_leave_rows_linear_and_scleronomic():
    found = jj.structure_of(Terrain())
    assert (found.affine, found.homogeneous, found.timed, found.driven, found.varying_inertia) == (
        True,
        True,
        (),
        False,
        False,
    )
