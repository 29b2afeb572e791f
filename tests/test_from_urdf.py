"""Scenes from URDF files: equations of closed forms and of scenes written by hand, shapes, and what is
refused.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from tolerances import relative_error, tolerance

import jourdain_jax as jj
from jourdain_jax.equations import unconstrained_equations
from jourdain_jax.program.eager import eval_numpy

ROBOT = (Path(__file__).parents[1] / "docs" / "howto" / "robot.urdf").read_text(encoding="utf-8")
LINK = (
    '<link name="{0}"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0"'
    ' izz="1"/></inertial></link>'
)
ARM = """
<robot name="arm">
  <link name="ground"><visual><geometry><box size="1 1 0.1"/></geometry></visual></link>
  <link name="first">
    <inertial><origin xyz="0.1 0.2 0.3" rpy="0.3 -0.4 0.5"/><mass value="2"/>
      <inertia ixx="0.1" ixy="0.01" ixz="-0.02" iyy="0.12" iyz="0.005" izz="0.09"/></inertial>
    <visual><origin xyz="0 0 0.2"/><geometry><box size="0.1 0.2 0.3"/></geometry><material name="m">
      <color rgba="1 0.5 0 0.5"/></material></visual>
  </link>
  <link name="frame"><visual><origin xyz="0.01 0 0"/><geometry><sphere radius="0.02"/></geometry></visual>
    </link>
  <link name="second">
    <inertial><origin xyz="0 0.1 0"/><mass value="1.5"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.04"/></inertial>
    <visual><geometry><cylinder radius="0.05" length="0.4"/></geometry></visual>
  </link>
  <link name="third"><inertial><mass value="0.5"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <joint name="turn" type="revolute">
    <parent link="ground"/><child link="first"/><origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/>
      <axis xyz="0 1 1"/>
    <limit lower="-1" upper="2" effort="5" velocity="3"/><dynamics damping="0.7"/>
  </joint>
  <joint name="hold" type="fixed"><parent link="first"/><child link="frame"/>
    <origin xyz="0 0 0.4" rpy="0 0 1"/></joint>
  <joint name="slide" type="prismatic"><parent link="frame"/><child link="second"/><axis xyz="0 0 2"/>
    <limit lower="0" upper="0.5"/></joint>
  <joint name="follow" type="continuous">
    <parent link="second"/><child link="third"/><origin xyz="0.3 0 0"/>
      <mimic joint="slide" multiplier="2" offset="0.1"/>
  </joint>
</robot>
"""


def test_a_file_is_read_as_its_text_is(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    scene = jj.from_urdf(path)()
    assert type(scene).__name__ == "Arm"
    assert scene.domain == {"turn": (-1.0, 2.0), "slide": (0.0, 0.5)}
    assert sorted(scene.bodies(0.0, scene.coordinate_names.view(jnp.zeros(3)))) == [
        "first",
        "second",
        "third",
    ]


def test_numbers_of_the_file_are_parameters():
    arm = jj.from_urdf(ARM)()
    q, u = jnp.array([0.3, 0.2, 0.5]), jnp.zeros(3)

    moment = lambda arm: unconstrained_equations(arm, 0.0, q, u).M[0, 0]
    found = lambda **changes: eval_numpy(moment)(arm.replace(**changes))
    # dM/dm of a point mass is the square of its distance from the axis; M is affine in masses and inertias
    slope = eval_numpy(jax.grad(moment))(arm).third_mass
    assert_allclose(slope, found(third_mass=1.5) - found(third_mass=0.5), rtol=1e-9)
    assert_allclose(found(third_inertia=jnp.full(3, 0.02)) - found(), 0.01, rtol=1e-9)
    refused("`first_mass`", arm.replace, first_mass=-1.0)
    assert not hasattr(arm, "slide_damping")  # zero in the file
    assert not hasattr(arm, "frame_origin")


def test_the_place_of_a_link_is_a_parameter_where_it_is_to_be_one():
    arm = jj.from_urdf(ARM, free=["frame", "third"])()
    q = jnp.array([0.3, 0.2, 0.5])
    slope = jax.jacobian(
        lambda origin: jj.pose_at(arm.replace(frame_origin=origin), 0.0, q)["third"].position
    )(arm.frame_origin)
    assert_allclose(slope, jj.pose_at(arm, 0.0, q)["first"].orientation, atol=1e-12)
    assert_allclose(arm.third_origin, [0.3, 0.0, 0.0])


class Robot(jj.from_urdf(ROBOT, base="planar", motors=["left", "right"])):
    """The robot of the page, on wheels that roll."""

    def contacts(self, pose):
        return {side: jj.disc_contact(pose[f"{side}_wheel"], 0.033, axis="z") for side in ("left", "right")}


def test_a_locked_joint_holds_its_link_where_it_would_have_moved_it():
    arm, held = jj.from_urdf(ARM)(), jj.from_urdf(ARM, locked={"turn": 0.3})()
    assert held.coordinate_names.entries == ("slide", "follow")
    own, expected = (
        jj.pose_at(held, 0.0, jnp.array([0.2, 0.5])),
        jj.pose_at(arm, 0.0, jnp.array([0.3, 0.2, 0.5])),
    )
    assert_allclose(own["third"].position, expected["third"].position, atol=1e-15)
    assert_allclose(own["third"].orientation, expected["third"].orientation, atol=1e-15)


def test_a_link_without_mass_may_be_fixed_and_a_joint_be_called_as_a_coordinate_of_the_base():
    tool = _joint("fixed", "b", "c", '<mimic joint="x"/>', "k")
    scene = jj.from_urdf(
        _robot(_joint("continuous", name="x"), tool, WEIGHT.format(0), links="ab"), base="planar"
    )()
    assert scene.coordinate_names.entries == ("x", "y", "heading", "x_")
    assert (float(scene.c_mass), float(scene.c_inertia[2])) == (0.0, 1.0)


def test_a_robot_on_two_wheels_follows_its_closed_form():
    # v, omega: of the middle of the axle; mass centre of the platform at -d; half track b; wheels of J, A
    #   (m + 2 mw + 2 J/r^2) vdot + m d omega^2 = (tr + tl)/r
    #   (I + 2 J b^2/r^2) omegadot - m d v omega = b (tr - tl)/r
    r, b, c, J, A, mw = 0.033, 0.08, 0.0002, 0.000018, 0.00001, 0.03
    platform, lidar, x_platform, x_lidar = 1.2, 0.15, -0.03, -0.05
    m, moment = platform + lidar, platform * x_platform + lidar * x_lidar
    turning = 0.008 + 0.0001 + platform * x_platform**2 + lidar * x_lidar**2 + 2 * (A + mw * b**2)
    robot, heading, v, omega, left, right = Robot(), 0.4, 0.3, 1.7, 0.01, -0.004
    u_left, u_right = (v - b * omega) / r, (v + b * omega) / r
    q = jnp.array([0.2, -0.1, heading, 0.5, 0.6])
    u = jnp.array([v * np.cos(heading), v * np.sin(heading), omega, u_left, u_right])
    tl, tr = left - c * u_left, right - c * u_right
    vdot = ((tr + tl) / r + moment * omega**2) / (m + 2 * mw + 2 * J / r**2)
    omegadot = (b * (tr - tl) / r - moment * v * omega) / (turning + 2 * J * b**2 / r**2)
    along, across = (
        np.array([np.cos(heading), np.sin(heading)]),
        np.array([-np.sin(heading), np.cos(heading)]),
    )
    expected = [
        *(vdot * along + v * omega * across),
        omegadot,
        (vdot - b * omegadot) / r,
        (vdot + b * omegadot) / r,
    ]
    found = jj.accelerations(robot, 0.0, q, u, {"left_motor": left, "right_motor": right}).udot
    assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("base", ["fixed", "planar", "free"])
def test_a_base_is_as_free_as_it_is_said_to_be(base):
    expected = {"fixed": (), "planar": ("x_rate", "y_rate", "heading_rate")}
    expected["free"] = (
        "x_rate",
        "y_rate",
        "z_rate",
        "attitude_omega_x",
        "attitude_omega_y",
        "attitude_omega_z",
    )
    assert jj.from_urdf(ROBOT, base=base)().speed_names.entries == (
        *expected[base],
        "left_rate",
        "right_rate",
    )


@pytest.mark.parametrize(("kind", "speeds"), [("floating", 6), ("planar", 3)])
def test_joints_of_several_coordinates_move_as_a_free_body(kind, speeds):
    axis = '<axis xyz="0 0.6 0.8"/>'
    text = (
        f'<robot name="r"><link name="a"/>{LINK.format("b")}<joint name="j" type="{kind}"><parent'
        f' link="a"/><child link="b"/>{axis}</joint></robot>'
    )
    scene = jj.from_urdf(text)()
    t, q, u = (x[0] for x in jj.sample_states(scene, 1))
    assert len(u) == speeds
    assert relative_error(unconstrained_equations(scene, t, q, u).M, np.eye(speeds)) < tolerance(
        "round_off"
    )  # 1 kg, 1 kg m^2
    motion = jj.motion_at(scene, t, q, u)["b"]
    if kind == "planar":
        normal = np.array([0.0, 0.6, 0.8])
        assert abs(motion.velocity @ normal) < 1e-12
        assert_allclose(motion.angular_velocity, u[2] * normal, atol=1e-12)
        assert_allclose(motion.velocity @ motion.velocity, u[0] ** 2 + u[1] ** 2, rtol=1e-12)


def test_shapes_are_drawn_where_the_file_has_them():
    scene = jj.from_urdf(ARM)()
    pose = jj.pose_at(scene, 0.0, [0.3, 0.2, 0.5])
    looks = scene.visuals(pose)
    assert {name: [look.kind for look in found] for name, found in looks.items()} == {
        "": ["box", "ellipsoid"],
        "first": ["box"],
        "second": ["cylinder"],
    }
    first = looks["first"][0]
    assert (first.colour, first.opacity) == ("#ff8000", 0.5)
    assert_allclose(first.position, [-0.1, -0.2, -0.1], atol=1e-12)  # from the mass centre
    R = np.asarray(pose["first"].orientation)
    ball = pose["first"].place([-0.1, -0.2, 0.1]) + R @ np.asarray(jj.rot_z(1.0)) @ np.array([0.01, 0.0, 0.0])
    assert_allclose(looks[""][1].position, ball, atol=1e-12)


def test_meshes_are_found_in_packages_and_beside_the_file(tmp_path):
    pytest.importorskip("trimesh")
    folder = tmp_path / "my_robot" / "urdf"
    (tmp_path / "my_robot" / "meshes").mkdir(parents=True)
    folder.mkdir()
    (tmp_path / "my_robot" / "meshes" / "part.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    mesh = '<visual><geometry><mesh filename="{}" scale="0.1 0.1 0.2"/></geometry></visual>'
    names = ("package://my_robot/meshes/part.obj", "../meshes/part.obj")
    link = LINK.format("b").replace("</link>", "".join(map(mesh.format, names)) + "</link>")
    (folder / "r.urdf").write_text(f'<robot name="r">{link}</robot>')
    scene = jj.from_urdf(folder / "r.urdf", base="free")()
    looks = scene.visuals(jj.pose_at(scene, 0.0, scene.coordinates.reference()))["b"]
    assert [look.kind for look in looks] == ["mesh", "mesh"]
    assert_allclose(looks[0].size, [0.1, 0.1, 0.2])


def test_elements_that_are_left_out_are_listed():
    extra = '<gazebo/><gazebo/><transmission name="t"/></robot>'
    mesh = (
        '<visual><geometry><mesh filename="package://gone/part.stl"/></geometry></visual></inertial></link>'
    )
    text = ROBOT.replace("</robot>", extra).replace("</inertial>\n  </link>", mesh, 1)
    with pytest.warns(UserWarning, match=r"omitted `gazebo` \(2\), `transmission`; `ignore` silences this"):
        jj.from_urdf(text)
    with pytest.warns(UserWarning, match=r"omitted `transmission`;"):
        jj.from_urdf(text, ignore="gazebo")


def _joint(kind="revolute", parent="a", child="b", inside="", name="j"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'
    )


def _robot(*parts, links="ab"):
    return f'<robot name="r">{"".join(LINK.format(name) for name in links)}{"".join(parts)}</robot>'


NO_INERTIA = '<link name="c"><inertial><mass value="1"/></inertial></link>'
WEIGHT = (
    '<link name="c"><inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0"'
    ' izz="1"/></inertial></link>'
)
BAD = {
    "no-file": ("nowhere.urdf", r"nowhere.urdf: cannot be read \(No such file"),
    "no-path": (None, r"`path` is `None`, expected the path of a URDF file"),
    "no-xml": ("<robot", r"not valid XML"),
    "another-root": ("<mujoco/>", r"its root is `mujoco`, expected `robot`"),
    "xacro": (
        '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:property name="x"/></robot>',
        r"elements of xacro",
    ),
    "no-links": ("<robot/>", r"it has no links"),
    "unknown-base": (_robot(_joint()), r"`base` is 'loose', expected one of 'fixed', 'planar', 'free'"),
    "unknown-type": (
        _robot(_joint("revolut")),
        r"joint `j` is of the type `revolut`; did you mean `revolute`",
    ),
    "unknown-link": (
        _robot(_joint(child="bb")),
        r"joint `j` has the child `bb`, which is not a link; did you mean `b`",
    ),
    "no-parent": (_robot(_joint().replace('<parent link="a"/>', "")), r"joint `j` has no `parent`"),
    "two-parents": (_robot(_joint(), _joint(name="k")), r"link `b` is the child of joints `j` and `k`"),
    "two-roots": (_robot(), r"links `a`, `b` have none"),
    "loop": (_robot(_joint(), _joint(parent="b", child="a", name="k")), r"there is a loop"),
    "loop-apart": (
        _robot(_joint(), _joint(parent="b", child="a", name="k"), links="abc"),
        r"link `a` is part of a loop",
    ),
    "no-inertia": (
        _robot(_joint(child="c"), NO_INERTIA, links="a"),
        r"link `c` has an `inertial` without `inertia`",
    ),
    "no-mass-moves": (
        _robot(_joint(child="c"), '<link name="c"/>', links="a"),
        r"link `c`, moved by `j`, has no mass",
    ),
    "negative-mass": (_robot(_joint(child="c"), WEIGHT.format(-1), links="a"), r"mass of link `c` is -1"),
    "mass-is-no-number": (
        _robot(_joint(child="c"), WEIGHT.format("heavy"), links="a"),
        r"value of `mass` of `inertial` of link `c` is `heavy`, expected",
    ),
    "axis-of-two": (
        _robot(_joint(inside='<axis xyz="1 0"/>')),
        r"xyz of `axis` of joint `j` is `1 0`, expected 3 numbers",
    ),
    "axis-zero": (_robot(_joint(inside='<axis xyz="0 0 0"/>')), r"xyz of `axis` of joint `j` is zero"),
    "friction": (
        _robot(_joint(inside='<dynamics friction="0.1"/>')),
        r'the friction of joint `j` is not supported.*ignore=\("friction",\)',
    ),
    "negative-damping": (
        _robot(_joint(inside='<dynamics damping="-1"/>')),
        r"damping of `dynamics` of joint `j` is -1",
    ),
    "unknown-motor": (_robot(_joint()), r"`motors` names `jj`, which is not a joint with one coordinate"),
    "unknown-free-link": (_robot(_joint()), r"`free` names `bb`, which is not a link; did you mean `b`"),
    "unknown-leader": (
        _robot(_joint(inside='<mimic joint="x"/>')),
        r"`mimic` of joint `j`: `x` is not a joint",
    ),
    "leader-of-itself": (
        _robot(_joint(inside='<mimic joint="j" multiplier="2"/>')),
        r"joint `j` mimics itself",
    ),
    "nothing-moves": (_robot(_joint("fixed")), r"no joint moves a body"),
    "unknown-locked": (
        _robot(_joint("planar")),
        r"`locked` names `j`, which is not a joint with one coordinate",
    ),
    "no-name": ("<robot><link/></robot>", r"a link has no `name`"),
    "two-names-become-one": (
        _robot(_joint(child="b-c"), _joint(child="b_c", name="k"), links=["a", "b-c", "b_c"]),
        r"`b-c` and `b_c` would both be called `b_c`",
    ),
    "empty-shape": (
        _robot(_joint(child="c"), WEIGHT.format(1).replace("</link>", "<visual/></link>"), links="a"),
        r"visual of link `c` has no shape",
    ),
}
OPTIONS = {
    "unknown-base": {"base": "loose"},
    "unknown-motor": {"motors": ["jj"]},
    "unknown-free-link": {"free": "bb"},
    "unknown-locked": {"locked": {"j": 0}},
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_become_a_scene_is_refused_by_name(case):
    path, message = BAD[case]
    refused(message, jj.from_urdf, path, **OPTIONS.get(case, {}))


def test_friction_may_be_left_out_on_purpose():
    scene = jj.from_urdf(_robot(_joint(inside='<dynamics friction="0.1"/>')), ignore=["friction"])()
    assert scene.coordinate_names.entries == ("j",)
