"""Scenes from MJCF files: mass matrix, bias forces, accelerations and energies are those of MuJoCo."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from tolerances import CLOSED_FORM, relative_error

import jourdain_jax as jj
from jourdain_jax.equations import generalized_forces, unconstrained_equations

# every body has one geom, or principal moments: MuJoCo diagonalises the inertia of several with an error of
# 1e-10
EVERYTHING = """
<mujoco model="everything">
  <compiler angle="{angle}" eulerseq="{sequence}"/>
  <option gravity="0.5 1 -9" timestep="0.001"><flag contact="disable" limit="disable"/></option>
  <default>
    <geom density="700"/>
    <default class="light"><geom density="200" rgba="0.2 0.4 0.6 1"/><joint damping="0.3"/></default>
  </default>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3" euler="{a} {b} {c}">
      <freejoint name="root"/>
      <geom type="box" size="0.2 0.1 0.05" pos="0.02 0 0" quat="1 0.2 0.1 0"/>
      <body name="upper" pos="0 0 0.2" axisangle="1 1 0 {a}" childclass="light">
        <joint name="shoulder" type="ball" pos="0.01 0 0"/>
        <geom type="capsule" fromto="0 0 0 0.1 0.2 0.4" size="0.03"/>
        <body name="fore-arm" pos="0.1 0.2 0.4" xyaxes="1 0.2 0 0 1 0.1">
          <joint name="elbow" axis="0 1 0.3" stiffness="4" springref="{b}" ref="{a}" range="-{c} {c}"/>
          <joint name="reach" type="slide" axis="1 0 0" pos="0.3 0 0" stiffness="9" springref="0.1"
            damping="0.2" ref="0.05"/>
          <geom class="main" type="cylinder" size="0.02 0.15" zaxis="1 1 1"/>
          <body name="tip" pos="0.2 0 0"><inertial pos="0.01 0.02 0" mass="0.3"
            diaginertia="0.01 0.012 0.014" quat="1 1 0 0.5"/></body>
          <body pos="0 0 0.1"><geom size="0.04"/></body>
          <body pos="0 0.1 0" euler="0 {a} 0">
            <joint axis="0 0 -1" pos="0.1 0 0"/><joint axis="1 0 0"/>
            <geom type="ellipsoid" size="0.03 0.05 0.07" pos="0.1 0.1 0"/>
          </body>
        </body>
      </body>
    </body>
    <body name="apart" pos="2 0 0" zaxis="0 -1 0">
      <joint name="al-one" type="hinge" axis="0 0 1" ref="{b}"/>
        <geom type="capsule" size="0.1 0.2" pos="0.3 0 0"/>
    </body>
  </worldbody>
  <actuator><motor name="pull" joint="reach" gear="3"/><motor joint="elbow"/></actuator>
</mujoco>
"""
DEGREES = EVERYTHING.format(angle="degree", sequence="xyz", a=10, b=20, c=30)
RADIANS = EVERYTHING.format(angle="radian", sequence="ZYx", a=0.2, b=-0.3, c=0.5)
CHANGES = {
    'joint="reach" gear="3"': 'site="s" gear="1 2 3 0.4 0.5 0.6"',
    '<body name="tip" pos="0.2 0 0">': (
        '<body name="tip" pos="0.2 0 0"><site name="s" pos="0.1 0.2 0" euler="0 50 0"/>'
    ),
    '<geom class="main"': (
        '<frame pos="0.1 0 0.2" euler="10 20 30"><frame axisangle="1 0 1 40"><geom class="main"'
    ),
    'zaxis="1 1 1"/>': 'zaxis="1 1 1"/></frame></frame>',
    '<body pos="0 0 0.1">': '<frame childclass="main" xyaxes="0 1 0 1 0 1"><body pos="0 0 0.1">',
    '<geom size="0.04"/></body>': '<geom size="0.04"/></body></frame>',
}
FRAMED = functools.reduce(lambda text, change: text.replace(*change), CHANGES.items(), DEGREES)
TEXTS = {
    "frames": FRAMED,
    "degrees": DEGREES,
    "radians": RADIANS,
    "no-gravity": DEGREES.replace('gravity="0.5 1 -9"', 'gravity="0 0 0"'),
}


@pytest.mark.parametrize("name", TEXTS)
def test_the_equations_are_those_of_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(TEXTS[name])
    data, scene = mujoco.MjData(model), jj.from_mjcf(TEXTS[name])()
    pushes = {"pull": 0.7, "elbow_motor": -0.4}
    generator, levels = np.random.default_rng(0), []
    for _ in range(3):
        q, u = generator.normal(size=model.nq), generator.normal(size=model.nv)
        for first in (3, 7):
            q[first : first + 4] /= np.linalg.norm(q[first : first + 4])
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, u, list(pushes.values())
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, M, data.qM)
        own = unconstrained_equations(scene, 0.0, q, u, pushes)
        assert relative_error(own.M, M) < CLOSED_FORM
        assert (
            relative_error(own.h - own.Q, data.qfrc_bias - data.qfrc_passive - data.qfrc_actuator)
            < CLOSED_FORM
        )
        assert relative_error(jj.accelerations(scene, 0.0, q, u, pushes).udot, data.qacc) < CLOSED_FORM
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        potential, kinetic = data.energy
        own = jj.energy(scene, 0.0, q, u, pushes)
        assert own.kinetic == pytest.approx(kinetic, rel=1e-10)
        levels.append(float(own.potential) - potential)
    assert_allclose(levels, levels[0], atol=1e-9)


@pytest.mark.parametrize(
    ("defaults", "gear"),
    [
        ('<general gear="7"/>', 7),
        ('<position gear="5"/><motor gear="3"/>', 3),
        ('<motor gear="3"/><position gear="5" kp="2"/>', 5),
    ],
)
def test_motors_share_the_defaults_of_all_actuators(defaults, gear):
    text = _body(HINGE, '<actuator><motor name="m" joint="j"/></actuator>', f"<default>{defaults}</default>")
    assert_allclose(
        generalized_forces(jj.from_mjcf(text)(), 0.0, np.zeros(1), np.zeros(1), {"m": 2.0}), [2.0 * gear]
    )


@pytest.mark.parametrize("near", [1e-9, 1e-7, 1e-5, 1e-3])
def test_an_axis_that_points_nearly_down_is_reached_by_the_shortest_turn(near):
    # half a turn less `near` about y: x goes to -x, and y stays
    text = (
        f'<mujoco><worldbody><body zaxis="{near} 0 -1"><joint name="j"/><geom size="0.1" pos="1 2'
        ' 0"/></body></worldbody></mujoco>'
    )
    (body,) = jj.pose_at(jj.from_mjcf(text)(), 0.0, np.zeros(1)).bodies.values()
    slope = np.array([near, -1.0]) / np.hypot(near, 1.0)  # of the axis: its x and z
    assert_allclose(body.position, [slope[1], 2.0, -slope[0]], rtol=0, atol=1e-15)


def test_the_stated_pose_is_the_example():
    scene = jj.from_mjcf(DEGREES)()
    start = jj.start(scene, **scene.example)
    expected = jj.rot_x(np.deg2rad(10)) @ jj.rot_y(np.deg2rad(20)) @ jj.rot_z(np.deg2rad(30))
    poses = jj.pose_at(scene, 0.0, start.q)
    assert_allclose(poses["base"].orientation, expected, atol=1e-12)
    assert start["elbow"] == pytest.approx(np.deg2rad(10))
    assert start["al_one"] == pytest.approx(np.deg2rad(20))
    assert scene.domain["elbow"] == (-np.deg2rad(30), np.deg2rad(30))
    for turn in ("0 1 0 0", "0.3 -0.5 0.1 0.2"):
        text = (
            f'<mujoco><worldbody><body name="b" quat="{turn}"><freejoint/><geom'
            ' size="1"/></body></worldbody></mujoco>'
        )
        q = np.array([jj.from_mjcf(text)().example[f"b_joint_attitude_{part}"] for part in "wxyz"])
        stated = np.array(turn.split(), float)
        assert_allclose(abs(q @ stated), np.linalg.norm(stated), rtol=1e-12)


def test_several_geoms_are_one_body():
    geoms = (
        '<geom type="box" size="0.2 0.1 0.05" pos="0.1 0 0" density="500"/><geom size="0.1" mass="3"'
        ' pos="-0.3 0.2 0"/>'
    )
    geoms += '<geom size="0.9" mass="0"/><geom size="9" density="0"/>'
    scene = jj.from_mjcf(
        f'<mujoco><worldbody><body name="b"><freejoint/>{geoms}</body></worldbody></mujoco>'
    )()
    box, ball = 500 * 8 * 0.2 * 0.1 * 0.05, 3.0
    centre = (box * np.array([0.1, 0, 0]) + ball * np.array([-0.3, 0.2, 0])) / (box + ball)
    apart = np.array([0.4, -0.2, 0.0])
    moved = box * ball / (box + ball) * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    own = np.diag(
        box / 3 * np.array([0.1**2 + 0.05**2, 0.2**2 + 0.05**2, 0.2**2 + 0.1**2])
    ) + 0.4 * ball * 0.1**2 * np.eye(3)
    assert_allclose(scene.b_mass, box + ball, rtol=1e-12)
    assert_allclose(scene.b_mass_centre, centre, atol=1e-12)
    assert_allclose(scene.b_inertia, own + moved, atol=1e-12)


# a parallelogram: two cranks of 0.3 m on the ground, 0.5 m apart, and a coupler that hangs on the first one
LINKAGE = """
<mujoco model="linkage"><compiler angle="radian"/>{option}<worldbody>
  <body name="first"><joint name="a" axis="0 1 0"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.2"/>
    <body name="coupler" pos="0 0 -0.3"><joint name="b" axis="0 1 0"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.5 0 0" mass="0.4"/></body></body>
  <body name="second" pos="0.5 0 0"><joint name="c" axis="0 1 0"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.2"/></body>
  <body name="wall" pos="3 0 0"><geom type="mesh" mesh="m"/></body>
</worldbody><equality>{equality}</equality></mujoco>
"""
CLOSED = {
    "connect": '<connect name="pin" body1="coupler" body2="second" anchor="0.5 0 0"/>',
    "joints": '<joint joint1="b" joint2="a" polycoef="0 -1"/><joint joint1="c" joint2="a"/>',
}


@pytest.mark.parametrize("way", CLOSED)
def test_a_loop_that_equality_closes_moves_as_its_closed_form(way):
    """T = (I + I + m L^2) thetadot^2 / 2 of both cranks and the coupler, which does not turn; V = -(m_1 L/2 +
    m_2 L/2 + m L) g cos theta.
    """
    scene = jj.from_mjcf(LINKAGE.format(option="", equality=CLOSED[way]))()
    theta = 0.4
    start = jj.start(scene, a=theta, a_rate=0.7)
    assert_allclose([start["b"], start["c"], start["b_rate"]], [-theta, theta, -0.7], atol=1e-9)
    own = float(scene.first_inertia[1]) + 0.2 * 0.15**2
    expected = -9.81 * (0.2 * 0.3 + 0.4 * 0.3) * np.sin(theta) / (2 * own + 0.4 * 0.3**2)
    assert jj.accelerations(scene, 0.0, start.q, start.u).udot[0] == pytest.approx(expected, rel=1e-9)
    motion = jj.simulate(scene, start, t1=1.0).raise_if_failed()
    assert jnp.abs(motion["b"] + motion["a"]).max() < 1e-7


def test_a_weld_holds_a_body_in_the_stated_pose():
    weld = '<weld body1="coupler" body2="second" anchor="0 0 -0.3"/><joint joint1="a" polycoef="0.2"/>'
    scene = jj.from_mjcf(
        LINKAGE.format(option="", equality=f'{weld}<connect body1="first" anchor="1 2 3" active="false"/>')
    )()
    rows = scene.geometric_constraints(jj.pose_at(scene, 0.0, [0.2, -0.1, 0.3]))
    assert_allclose(rows["a is held"], 0.0, atol=1e-15)
    # the coupler is turned by a + b = 0.1, the second crank by 0.3
    assert_allclose(rows["weld 1 of `equality`, attitude"], [0.0, -2 * np.sin(0.2), 0.0], atol=1e-12)
    tip = np.array([0.5 - 0.3 * np.sin(0.3), 0.0, -0.3 * np.cos(0.3)])
    pin = np.array([-0.3 * np.sin(0.2) + 0.5 * np.cos(0.1), 0.0, -0.3 * np.cos(0.2) - 0.5 * np.sin(0.1)])
    assert_allclose(rows["weld 1 of `equality`"], tip - pin, atol=1e-12)


def test_files_are_included_once_and_gravity_may_be_off(tmp_path):
    (tmp_path / "closed.xml").write_text(
        f"<mujoco><option><flag gravity='disable'/></option><equality>{CLOSED['joints']}</equality></mujoco>"
    )
    text = LINKAGE.format(option='<include file="closed.xml"/>', equality="")
    (tmp_path / "arm.xml").write_text(text)
    scene = jj.from_mjcf(tmp_path / "arm.xml")()
    assert not hasattr(scene, "gravity")
    assert len(scene.geometric_constraints(jj.pose_at(scene, 0.0, np.zeros(3)))) == 2
    (tmp_path / "closed.xml").write_text("<mujoco><include file='closed.xml'/></mujoco>")
    refused(r"`closed.xml` is included twice", jj.from_mjcf, tmp_path / "arm.xml")


def test_geoms_are_drawn():
    scene = jj.from_mjcf(DEGREES)()
    looks = scene.visuals(jj.pose_at(scene, 0.0, jj.start(scene, **scene.example).q))
    assert {name: [look.kind for look in found] for name, found in looks.items()} == {
        "base": ["box"],
        "upper": ["capsule"],
        "fore-arm": ["cylinder"],
        "body5": ["ellipsoid"],
        "body6": ["ellipsoid"],
        "apart": ["capsule"],
    }
    assert_allclose(looks["base"][0].size, [0.4, 0.2, 0.1])
    assert_allclose(looks["apart"][0].size, [0.1, 0.4])
    assert looks["upper"][0].colour == "#336699"


def test_what_moves_nothing_is_listed():
    idle = '<camera name="eye"/><light/><light/><geom type="plane" size="1 1 1"/>'
    text = _body(HINGE).replace("<worldbody>", f"<sensor/><worldbody>{idle}")
    with pytest.warns(UserWarning, match=r"omitted `camera`, `geom of type plane`, `light` \(2\), `sensor`;"):
        jj.from_mjcf(text)


def _body(inside, outside="", compiler=""):
    return (
        f'<mujoco>{compiler}<worldbody><body name="b"><geom'
        f' size="0.1"/>{inside}</body></worldbody>{outside}</mujoco>'
    )


HINGE = '<joint name="j"/>'
BAD = {
    "no-file": ("nowhere.xml", r"nowhere.xml: cannot be read"),
    "another-root": ("<robot/>", r"its root is `robot`, expected `mujoco`"),
    "nothing-moves": (_body(""), r"no joint moves a body"),
    "unknown-joint": (
        _body('<joint name="j" type="hing"/>'),
        r"joint `j` is of the type `hing`; did you mean `hinge`",
    ),
    "armature": (
        _body('<joint name="j" armature="0.1"/>'),
        r'`armature="0.1"` of joint `j` is not supported.*ignore=\("armature",\)',
    ),
    "ball-spring": (
        _body('<joint name="j" type="ball" stiffness="1"/>'),
        r"the stiffness of the ball joint `j` is not supported",
    ),
    "equality": (
        _body(HINGE, '<equality><joint joint1="k"/></equality>'),
        r"joint 1 of `equality` names `k`, which is not a hinge or slide",
    ),
    "no-anchor": (
        _body(HINGE, '<equality><connect body1="b"/></equality>'),
        r"anchor of connect 1 of `equality` is missing",
    ),
    "tendon-equality": (
        _body(HINGE, "<equality><tendon/></equality>"),
        r"`tendon` in `equality` is not supported",
    ),
    "include": (_body(HINGE, '<include file="x.xml"/>'), r"x.xml: cannot be read"),
    "servo": (
        _body(HINGE, '<actuator><position name="p" joint="j"/></actuator>'),
        r"`position` `p` in `actuator` is not supported",
    ),
    "motor-of-nothing": (
        _body(HINGE, '<actuator><motor name="p" joint="k"/></actuator>'),
        r"motor `p` pushes `k`, which is not a hinge or slide",
    ),
    "motor-of-no-site": (
        _body(HINGE, '<actuator><motor name="p" site="s"/></actuator>'),
        r"motor `p` pushes the unknown site `s`",
    ),
    "massless": (
        f'<mujoco><worldbody><body name="b">{HINGE}</body></worldbody></mujoco>',
        r"link `b`, moved by `j`, has no mass",
    ),
    "mesh-of-unknown-mass": (
        _body(f'{HINGE}<geom type="mesh" mesh="m"/>'),
        r"the mass of a geom of body `b`, of the type `mesh`, is not supported",
    ),
    "no-inertia": (
        _body(f'{HINGE}<inertial pos="0 0 0" mass="1"/>'),
        r"`inertial` of body `b` has neither `diaginertia` nor `fullinertia`",
    ),
    "negative-mass": (
        _body(f'{HINGE}<inertial pos="0 0 0" mass="-1" diaginertia="1 1 1"/>'),
        r"mass of `inertial` of body `b` is -1",
    ),
    "no-size": (
        _body(f'{HINGE}<geom name="g" type="box" size="1 1"/>'),
        r"size of geom `g` of body `b` is `1 1`, expected 3 lengths",
    ),
    "no-class": (
        _body('<joint name="j" class="heavy"/>'),
        r"joint `j` has the class `heavy`, which no `default` defines",
    ),
    "default-without-class": (
        _body(HINGE, compiler="<default><default/></default>"),
        r"a `default` inside the class `main` has no `class`",
    ),
    "free-below": (
        _body(f'{HINGE}<body name="c"><freejoint/><geom size="1"/></body>'),
        r"body `c` has a free joint and a parent",
    ),
    "quaternion-zero": (
        _body(f'{HINGE}<body name="c" quat="0 0 0 0"/>'),
        r"quat of body `c` is `0 0 0 0`, which is not a rotation",
    ),
    "no-axis": (
        _body(f'{HINGE}<body name="c" axisangle="0 0 0 30"/>'),
        r"axisangle of body `c` is `0 0 0 30`, which is not a rotation",
    ),
    "parallel-axes": (
        _body(f'{HINGE}<body name="c" xyaxes="1 0 0 2 0 0"/>'),
        r"xyaxes of body `c` is `1 0 0 2 0 0`, which is not a rotation",
    ),
    "two-rotations": (
        _body(f'{HINGE}<body name="c" euler="1 2 3" quat="1 0 0 0"/>'),
        r"body `c` is rotated by `quat` and by `euler`; expected one of them",
    ),
    "unit-of-angles": (
        _body(HINGE, compiler='<compiler angle="radians"/>'),
        r"`angle` of `compiler` is `radians`; did you mean `radian`\?",
    ),
    "sequence": (
        _body(HINGE, compiler='<compiler eulerseq="xyq"/>'),
        r"`eulerseq` of `compiler` is `xyq`, expected three letters",
    ),
    "geom-of-negative-mass": (
        _body(f'{HINGE}<geom size="1" mass="-1"/>'),
        r"mass of a geom of body `b` is -1",
    ),
    "renamed-main": (
        _body(HINGE, compiler='<default class="robot"><joint damping="3"/></default>'),
        r"outermost `default` has the class `robot`",
    ),
    "axis-zero": (_body('<joint name="j" axis="0 0 0"/>'), r"axis of joint `j` is zero"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_become_a_scene_is_refused_by_name(case):
    text, message = BAD[case]
    refused(message, jj.from_mjcf, text)


@pytest.mark.parametrize("case", ["armature", "equality", "servo", "ball-spring"])
def test_what_is_ignored_on_purpose_is_left_out(case):
    keys = {"armature": "armature", "equality": "equality", "servo": "position", "ball-spring": "stiffness"}
    assert jj.from_mjcf(BAD[case][0], ignore=keys[case])().b_mass == pytest.approx(4000 / 3 * np.pi * 0.1**3)
