"""Trees of links with the tensors of inertia of real robots: thin shells, long bones, products of inertia
beside small moments. All are lowered.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

import jourdain_jax as jj

BONE = np.array([[3e-5, 5e-5, 0.0], [5e-5, 4e-4, 0.0], [0.0, 0.0, 4.1e-4]])  # kg m^2
START, SPAN = {"j00": 0.3, "j01_rate": 0.7}, {"t1": 0.2, "ts": [0.0, 0.2]}


def inertial(mass, centre, I):
    moments = " ".join(f'i{"xyz"[i]}{"xyz"[j]}="{I[i, j]}"' for i in range(3) for j in range(i, 3))
    return (
        f'<inertial><origin xyz="{centre[0]} {centre[1]} {centre[2]}"/><mass value="{mass}"/><inertia'
        f" {moments}/></inertial>"
    )


def possible_tensor(draw, thin):
    """I = tr(S) 1 - S of a body turned at random, whose second moment S about one axis is `thin` beside the
    largest.
    """
    turn, size = np.linalg.qr(draw.normal(size=(3, 3)))[0], 10.0 ** draw.uniform(-6, -2)
    S = turn @ np.diag(size * np.array([1.0, draw.uniform(0.01, 1.0), thin])) @ turn.T
    return np.trace(S) * np.eye(3) - S


def tree(seed, legs, joints, tensor):
    """A trunk with legs, each a chain of revolute joints, its links with what `tensor` draws."""
    draw = np.random.default_rng(seed)
    moments = np.array([[0.01, 1e-4, 2e-4], [1e-4, 0.03, 1e-5], [2e-4, 1e-5, 0.035]])
    parts = [f'<link name="trunk">{inertial(4.0, (0.01, 0.0, 0.0), moments)}</link>']
    for leg in range(legs):
        names = ["trunk", *(f"l{leg}{k}" for k in range(joints))]
        for k, (parent, name) in enumerate(itertools.pairwise(names)):
            at, axis = draw.normal(size=3) * 0.1, "1 0 0" if k == 0 else "0 1 0"
            inside = inertial(draw.uniform(0.05, 0.5), 0.03 * draw.normal(size=3), tensor(draw))
            parts.append(f'<link name="{name}">{inside}</link>')
            parts.append(
                f'<joint name="j{leg}{k}" type="revolute"><parent link="{parent}"/><child link="{name}"/>'
            )
            parts.append(f'<origin xyz="{at[0]} {at[1]} {at[2]}"/><axis xyz="{axis}"/></joint>')
    return f'<robot name="walker">{"".join(parts)}</robot>'


def drawn(seed):
    """A tree by its number: thin links down to flat ones, and bones as a quadruped has them."""
    draw = np.random.default_rng([7, seed])
    thin = [1e-2, 1e-4, 1e-8, 0.0][seed % 4]
    tensor = (lambda _: BONE) if seed % 5 == 4 else lambda draw: possible_tensor(draw, thin)
    legs, joints = int(draw.integers(1, 3)), int(draw.integers(2, 4))
    return jj.from_urdf(tree(seed, legs, joints, tensor), base="planar" if seed % 3 == 2 else "fixed")


@pytest.mark.parametrize("seed", [2, *range(4, 40)])
def test_every_tree_is_lowered(seed):
    assert jj.lower(drawn(seed)()).operations > 0


def test_a_quadruped_on_a_free_base_is_lowered():
    built = str(jj.build(jj.from_urdf(tree(0, 4, 3, lambda draw: BONE), base="free")()))
    assert "operations" in built
    assert "dense" not in built


def test_a_tree_whose_tensors_are_traced_first_is_lowered_too():
    scene = jj.from_urdf(tree(2, 1, 2, lambda draw: BONE))()
    jax.jit(lambda I: jj.simulate(scene.replace(l01_inertia=I), START, **SPAN).q_end)(BONE)
    assert jj.lower(scene).operations > 0
    tensors = np.stack([BONE, 1.2 * BONE])
    lanes = jj.rollout(scene, START, **SPAN, parameters={"l01_inertia": tensors})
    for found, tensor in zip(lanes["j01"], tensors, strict=True):
        alone = jj.simulate(scene.replace(l01_inertia=tensor), START, **SPAN)
        assert_allclose(found, alone["j01"], rtol=1e-9)


class Spinning(jj.Scene):
    """A small body whose products of inertia are numbers of their own, one of them zero."""

    across: object = jj.parameter(5e-5, unit="kg m^2")
    beside: object = jj.parameter(0.0, unit="kg m^2")
    coordinates = jj.coordinates("yaw lean spin")
    domain = {"lean": (-1.0, 1.0), "spin": (-1.0, 1.0)}

    def bodies(self, t, q):
        a, b = self.across, self.beside
        I = jnp.stack([jnp.stack(row) for row in ([3e-5, a, b], [a, 4e-4, 0.0], [b, 0.0, 4.1e-4])])
        turned = jj.rot_z(q.yaw) @ jj.rot_x(q.lean) @ jj.rot_y(q.spin)
        return {"body": jj.RigidBody(1.0, I, jnp.zeros(3), turned)}


def test_products_of_inertia_that_are_parameters_of_their_own_are_varied_within_what_bodies_have():
    assert jj.lower(Spinning()).operations > 0


JOINT = '<joint name="j" type="continuous"><parent link="base"/><child link="arm"/></joint>'
PENDULUM = '<robot name="p"><link name="base"/><link name="arm">{}</link>' + JOINT + "</robot>"


def pendulum(tensor):
    return PENDULUM.format(inertial(1.0, (0.0, 0.3, 0.0), tensor))


@pytest.mark.parametrize("noise", [2e-35, -1e-33, 1e-22])
def test_round_off_in_a_tensor_of_zeros_is_no_moment(noise):
    tensor = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    ends = [
        jj.simulate(jj.from_urdf(pendulum(size * tensor))(), {"j": 0.3}, **SPAN).q_end
        for size in (noise, 0.0)
    ]
    assert_array_equal(*ends)


class Point(jj.Scene):
    coordinates = jj.coordinates("q")
    noise: object = jj.parameter(2e-35, unit="kg m^2")

    def bodies(self, t, q):
        I = self.noise * jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        return {"bob": jj.RigidBody(1.0, I, jj.rot_x(q.q) @ jnp.array([0.0, 1.0, 0.0]), jj.rot_x(q.q))}


def test_round_off_in_a_tensor_of_a_scene_is_no_negative_moment():
    motion = jj.simulate(Point(), {"q_rate": 1.0}, **SPAN)
    assert motion.result == 0
    assert_allclose(motion.q_end, [0.2], rtol=1e-9)
    noise = {"noise": jnp.array([2e-35, -1e-33])}
    assert not np.any(jj.rollout(Point(), {"q_rate": 1.0}, **SPAN, parameters=noise).result)


@pytest.mark.parametrize(
    "moments", [(1.0, 1.0, 2.2), (3.0, 1.0, 1.0), (0.0, 0.0, 1.0), (1.0, -0.5, 1.2), (-1e-3, 0.0, 0.0)]
)
@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_moments_that_no_body_has_are_refused_when_they_are_read(moments, form):
    refused(r"link `arm` has principal moments of inertia .* impossible for a body", _pendulum, form, moments)


@pytest.mark.parametrize(
    "moments", [(1.0, 1.0, 2.0), (1.0, 1.0, 2.05), (0.0, 1.0, 1.0), (0.0, 0.0, 0.0), (1e-3, 2e-3, 2.5e-3)]
)
@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_moments_of_discs_rods_and_points_are_read(moments, form):
    assert _pendulum(form, moments)().arm_mass == 1.0


@pytest.mark.parametrize("moments", [(0.0, 0.0, 3e-6), (1e-4, -1e-4, 1e-4)])
def test_moments_of_links_that_are_fixed_to_each_other_are_judged_together(moments):
    plate = f'<link name="plate">{inertial(0.1, (0.0, 0.0, 0.0), np.diag(moments))}</link>'
    joint = (
        '<joint name="f" type="fixed"><parent link="arm"/><child link="plate"/><origin xyz="0 0 0.1" rpy="0.3'
        ' 0.2 0.1"/></joint></robot>'
    )
    arm = pendulum(0.01 * np.eye(3))
    assert jj.from_urdf(arm.replace("</robot>", plate + joint))().plate_mass == 0.1
    refused(
        r"link `arm`, with links fixed to it, has principal moments",
        jj.from_urdf,
        arm.replace("0.01", "1e-8")
        .replace('xyz="0.0 0.3 0.0"', "")
        .replace("</robot>", (plate + joint).replace("0 0 0.1", "0 0 0")),
    )


def test_moments_that_no_body_has_are_read_on_purpose_and_replaced():
    text = pendulum(np.diag((1.0, 1.0, 3.0)))
    arm = jj.from_urdf(text, ignore="inertia")()
    assert_array_equal(arm.arm_inertia, (1.0, 1.0, 3.0))
    refused("above the sum of the others", jj.simulate, arm, **SPAN)
    assert jj.simulate(arm.replace(arm_inertia=(1.0, 1.0, 2.0)), **SPAN).result == 0


def _pendulum(form, moments):
    if form == "urdf":
        return jj.from_urdf(pendulum(np.diag(moments)))
    stated = f'<inertial pos="0 0.3 0" mass="1" diaginertia="{moments[0]} {moments[1]} {moments[2]}"/>'
    return jj.from_mjcf(
        '<mujoco><worldbody><body name="arm"><joint name="j" axis="1 0'
        f' 0"/>{stated}</body></worldbody></mujoco>'
    )
