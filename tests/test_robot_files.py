"""What elements of robot files may hold: each neighbour of a file that says something else is refused by
name; and files that cannot be read.
"""

import contextlib
import copy
import re
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

import jourdain_jax as jj

URDF = """
<robot name="arm" version="1.0">
  <material name="dark"><color rgba="0.2 0.2 0.2 1"/><texture filename="a.png"/></material>
  <link name="ground"><visual name="v"><origin xyz="0 0 1" rpy="0 0 1"/><geometry><box size="1 1 0.1"/>
    </geometry><material name="dark"/></visual></link>
  <link name="first">
    <inertial><origin xyz="0.1 0.2 0.3" rpy="0.3 -0.4 0.5"/><mass value="2"/>
      <inertia ixx="0.1" ixy="0.01" ixz="-0.02" iyy="0.12" iyz="0.005" izz="0.09"/></inertial>
    <visual><geometry><cylinder radius="0.05" length="0.4"/></geometry></visual>
  </link>
  <link name="second"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
    </inertial>
    <visual><geometry><sphere radius="0.1"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="ground"/><child link="first"/><origin xyz="0.1 0 0"/>
    <axis xyz="0 1 1"/>
    <limit lower="-1" upper="2" effort="5" velocity="3"/><dynamics damping="0.7" friction="0"/></joint>
  <joint name="slide" type="prismatic"><parent link="first"/><child link="second"/><axis xyz="0 0 2"/>
    <mimic joint="turn" multiplier="2" offset="0.1"/></joint>
</robot>
"""
MJCF = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/><option gravity="0 0 -9.81"><flag energy="enable"/></option>
  <default><geom density="500"/><default class="heavy"><joint damping="0.1"/></default></default>
  <asset><mesh name="m" file="m.obj"/></asset>
  <worldbody><geom type="box" size="1 1 1" pos="0 0 -1"/>
    <body name="a" pos="0 0 1" euler="0 0 1"><joint name="first" class="heavy" axis="0 1 0" range="-1 1"/>
      <inertial mass="2" pos="0 0 -0.4" diaginertia="0.1 0.1 0.01"/>
      <body name="b" pos="0 0 -0.8"><joint name="second" axis="0 1 0" stiffness="5" springref="0.3"/>
        <geom name="g" size="0.1" rgba="1 0 0 1"/></body>
    </body>
    <body name="c"><freejoint name="loose"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><motor name="push" joint="second" gear="2" ctrlrange="-1 2" forcerange="-1 1"/></actuator>
</mujoco>
"""
FILES = {"urdf": (jj.from_urdf, URDF), "mjcf": (jj.from_mjcf, MJCF)}
SEVERAL = {
    "link",
    "joint",
    "visual",
    "material",
    "body",
    "geom",
    "motor",
    "mesh",
    "compiler",
    "option",
    "worldbody",
    "asset",
    "actuator",
    "default",
    "freejoint",
}


def elements(root, unlike=()):
    """Every element below one, and its place: the path of its numbers; those `unlike` these tags."""
    for k, element in enumerate(root):
        if element.tag not in unlike:
            yield (k,), element
            yield from (((k, *place), inner) for place, inner in elements(element, unlike))


def at(root, place):
    for k in place:
        root = root[k]
    return root


def neighbours(form):
    """Files that differ from the right one in one place, and what must be named."""
    reader, text = FILES[form]
    whole = ElementTree.fromstring(text)
    for place, element in [((), whole), *elements(whole, ("texture", "mesh"))]:
        if form == "mjcf" and element.tag in ("geom", "joint") and place[0] == 2:
            continue  # in a class of defaults: an attribute counts where it is used
        where = f"{form}-{'-'.join(map(str, place))}-{element.tag}"

        def changed(change, place=place):
            root = copy.deepcopy(whole)
            change(at(root, place), at(root, place[:-1]))
            return reader, ElementTree.tostring(root, encoding="unicode")

        changes = [  # what is changed, how, and what must be said
            ("text", lambda x, _: setattr(x, "text", "0 1 0"), "the text `0 1 0` in .* is not supported"),
            (
                "tail",
                lambda x, above: setattr(x, "text" if x is above else "tail", "0 1 0"),
                "the text `0 1 0` in ",
            ),
            ("attribute", lambda x, _: x.set("spring", "3"), '`spring="3"` of .* is not supported'),
            (
                "child",
                lambda x, _: ElementTree.SubElement(x, "loop_joint", name="l"),
                "`loop_joint` `l` in .* is not supported",
            ),
        ]
        if place and element.tag not in SEVERAL:
            said = f"has 2 elements `{element.tag}`, expected one|several shapes"
            changes.append(("twice", lambda x, above: above.append(copy.deepcopy(x)), said))
        for what, change, said in changes:
            yield f"{where}-{what}", *changed(change), said
        for name in element.attrib:
            if f"{element.tag} {name}" == "visual name":
                continue
            if name not in ("effort", "velocity", "version", "energy", "mesh"):
                misspell = lambda x, _, name=name: x.set(name[:-1] + "_", x.attrib.pop(name))
                yield f"{where}-{name}", *changed(misspell), rf"`{name[:-1]}_=.*is not supported"


NEIGHBOURS = {name: rest for form in FILES for name, *rest in neighbours(form)}


def test_the_files_themselves_are_read():
    for reader, text in FILES.values():
        with contextlib.suppress(UserWarning):
            assert reader(text)().coordinate_names.entries


@pytest.mark.parametrize("form", FILES)
def test_what_an_element_may_not_hold_is_refused_by_name(form):
    cases = {name: case for name, case in NEIGHBOURS.items() if name.startswith(form)}
    assert len(cases) > 110
    passed = []
    for name, (reader, text, message) in cases.items():
        try:
            reader(text)
            passed.append(f"{name}: read")
        except ValueError as error:
            if not re.search(message, str(error)):
                passed.append(f"{name}: {error}")
    assert not passed, "\n".join(passed)


@pytest.mark.parametrize("form", FILES)
def test_what_is_said_twice_is_refused(form):
    reader, text = FILES[form]
    for tag in ("link", "joint", "body", "motor"):
        if f"<{tag} " in text:
            names = re.findall(rf'<{tag} name="(\w+)"', text)
            twice = (
                text.replace(f'"{names[0]}"', f'"{names[-1]}"')
                if len(names) > 1
                else re.sub(r"(<motor .*?/>)", r"\1\1", text)
            )
            refused(r"two \w+s are called `", reader, twice)
    if form == "mjcf":
        refused(
            "two `default` elements have the class `heavy`",
            reader,
            text.replace("</default></default>", '</default><default class="heavy"/></default>'),
        )
        refused(
            "the text `3` in `joint` of the class `heavy` is not supported",
            reader,
            text.replace('<joint damping="0.1"/>', "<joint>3</joint>"),
        )
        refused(
            "the class `main` defines `geom` twice",
            reader,
            text.replace('<geom density="500"/>', '<geom density="500"/><geom density="400"/>'),
        )


ASIDE = [
    ('<axis xyz="0 1 1"/>', "<axis><xyz>0 1 1</xyz></axis>", "xyz"),
    ("</robot>", "<loop_joint/></robot>", "loop_joint"),
    ("</robot>", "<force_element/></robot>", "force_element"),
    ("</robot>", "words</robot>", "text"),
    ('friction="0"', 'spring="3"', "spring"),
    ('damping="0.7"', 'dampin="0.7"', "dampin"),
    ("</robot>", '<d:joint xmlns:d="drake.mit.edu"/></robot>', "joint"),
    ("<dynamics", '<dynamics xmlns:d="drake.mit.edu" d:rotor="1"', "rotor"),
]


@pytest.mark.parametrize(("old", "new", "key"), ASIDE)
def test_what_is_refused_can_be_left_out_on_purpose(old, new, key):
    text = URDF.replace(old, new)
    refused(rf"is not supported; .*ignore=\(\"{key}\",\)", jj.from_urdf, text)
    assert jj.from_urdf(text, ignore=key)().coordinate_names.entries == ("turn", "slide")


def test_a_misspelt_name_is_put_right():
    refused(
        r'`dampin="0.7"` of `dynamics` of joint `turn` is not supported; did you mean `damping`\?',
        jj.from_urdf,
        URDF.replace('damping="0.7"', 'dampin="0.7"'),
    )


IDLE = """<collision><geometry><box/>any</geometry></collision></link>"""


@pytest.mark.filterwarnings("error")
def test_elements_without_influence_on_the_motion_are_read_over():
    own = jj.from_urdf(URDF)()
    calm = URDF.replace("</link>", IDLE).replace(
        "</robot>", "<gazebo>x<y/></gazebo><transmission name='t'/><ros2_control/></robot>"
    )
    other = jj.from_urdf(calm, ignore=("gazebo", "transmission", "ros2_control"))()
    q, u = jj.start(own).q, jj.start(own).u
    assert_array_equal(jj.accelerations(own, 0.0, q, u).udot, jj.accelerations(other, 0.0, q, u).udot)
    with pytest.raises(UserWarning, match=r"omitted `gazebo`, `ros2_control`, `transmission`"):
        jj.from_urdf(calm)


NO_FILES = {
    "encoding": b'<?xml version="1.0" encoding="klingon"?><robot name="r"/>',
    "zero-byte": b'<robot name="r\x00"/>',
    "half": URDF.encode()[:300],
    "bytes": bytes(range(256)),
    "latin": '<robot name="\u00e4"/>'.encode("latin-1"),
    "empty": b"",
    "deep": b"<robot name='r'>" + b"<link>" * 1200 + b"</link>" * 1200 + b"</robot>",
    "very-deep": b"<robot>" * 100_000 + b"</robot>" * 100_000,
    "bodies": b"<mujoco><worldbody>" + b"<body>" * 1200 + b"</body>" * 1200 + b"</worldbody></mujoco>",
    "laughs": (
        b'<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">'
        + b"".join(b'<!ENTITY a%d "%s">' % (k, b"&a%d;" % (k - 1) * 20 if k else b"&a;") for k in range(9))
        + b"]><r>&a8;</r>"
    ),
}


@pytest.mark.parametrize("case", NO_FILES)
@pytest.mark.parametrize("reader", [jj.from_urdf, jj.from_mjcf])
def test_files_that_are_none_are_refused_with_their_name(tmp_path, reader, case):
    path = tmp_path / "robot.xml"
    path.write_bytes(NO_FILES[case])
    assert len(refused(r"robot.xml: ", reader, path)) < 1000
    if NO_FILES[case].startswith(b"<") and NO_FILES[case].isascii():
        refused(r"the (URDF|MJCF) text: ", reader, NO_FILES[case].decode())


@pytest.mark.parametrize("path", ["x" * 10_000, "zero\0byte.urdf", ".", ""])
@pytest.mark.parametrize("reader", [jj.from_urdf, jj.from_mjcf])
def test_paths_that_are_none_are_refused(reader, path):
    assert len(refused("cannot be read|expected the name of a file", reader, path)) < 600


NO_NUMBERS = ["1_0", "\u0661", "\uff11", "0x1", "nan", "inf", "1e999", "1,5", "", "1\u00a00"]


@pytest.mark.parametrize("number", NO_NUMBERS)
def test_what_is_no_number_is_refused_with_its_place(number):
    for form, old, what in (
        ("urdf", 'mass value="2"', "value of `mass` of `inertial` of link `first`"),
        ("urdf", 'damping="0.7"', "damping of `dynamics` of joint `turn`"),
        ("urdf", 'lower="-1"', "lower of `limit` of joint `turn`"),
        ("mjcf", 'mass="2"', "mass of `inertial` of body `a`"),
        ("mjcf", 'gear="2"', "gear of motor `push`"),
        ("mjcf", 'density="500"', "density of.*"),
    ):
        reader, text = FILES[form]
        refused(
            rf"the {form.upper()} text: {what} is `.*`, expected",
            reader,
            text.replace(old, re.sub('".*"', f'"{number}"', old)),
        )


@pytest.mark.parametrize("name", ["m" * 10_000 + ".stl", "package://p/" + "m" * 10_000, "a\ufffd.stl"])
def test_meshes_that_are_nowhere_are_listed_in_short(name):
    text = URDF.replace('<sphere radius="0.1"/>', f'<mesh filename="{name}"/>')
    with pytest.warns(UserWarning, match="omitted `mesh ") as told:
        jj.from_urdf(text)
    assert len(str(told[0].message)) < 300
    with pytest.warns(UserWarning, match="omitted `geom of type mesh`"):
        jj.from_mjcf(
            MJCF.replace("m.obj", name).replace(
                '<geom name="g" size="0.1"', '<geom type="mesh" mesh="m" mass="0"/><geom name="g" size="0.1"'
            )
        )


# motors -----------------------------------------------------------------------------------------------------

MOTORS = [
    "",
    'ctrlrange="-1 2"',
    'ctrlrange="-1 2" ctrllimited="false"',
    'ctrlrange="-1 2" ctrllimited="true"',
    'ctrlrange="-1 2" ctrllimited="auto"',
    'ctrllimited="true"',
    'ctrlrange="2 -1"',
    'ctrlrange="1 1"',
    'forcerange="-1 1"',
    'forcelimited="true"',
    'forcerange="-1 1" forcelimited="false"',
    'ctrlrange="1 3" forcerange="-2 2" gear="-3"',
    'ctrlrange="3 4" forcerange="-2 2" gear="2 1"',
    'forcerange="0 1" gear="10"',
    'ctrlrange="1"',
    'ctrllimited="false" forcelimited="false" gear="2"',
    'ctrlrange="-1 0.1" ctrllimited="true" forcelimited="false"',
]
BODY = (
    '<body name="a{0}"><joint name="j{0}" type="hinge"/><inertial pos="0 0 0" mass="1" diaginertia="1 1'
    ' 1"/></body>'
)
DEFAULT = '<default><general ctrlrange="-0.4 0.3" forcerange="-0.2 5"/></default>'


def swinging(motors, compiler="", sections=""):
    """Bodies of 1 kg m^2, each on a hinge with one motor."""
    bodies, pushes = (
        (BODY.format(k) for k in range(len(motors))),
        (f'<motor name="m{k}" joint="j{k}" {motor}/>' for k, motor in enumerate(motors)),
    )
    head = f'<mujoco><compiler {compiler} inertiafromgeom="false"/><option gravity="0 0 0"/>{sections}'
    return f"{head}<worldbody>{''.join(bodies)}</worldbody><actuator>{''.join(pushes)}</actuator></mujoco>"


@pytest.mark.parametrize("sections", ["", DEFAULT])
@pytest.mark.parametrize("compiler", ["", 'autolimits="false"'])
def test_motors_are_clamped_as_they_are_by_mujoco(compiler, sections):
    mujoco = pytest.importorskip("mujoco")
    right = []
    for motor in MOTORS:
        try:
            mujoco.MjModel.from_xml_string(swinging([motor], compiler, sections))
            right.append(motor)
        except ValueError:
            refused("motor `m0`", jj.from_mjcf, swinging([motor], compiler, sections))
    text = swinging(right, compiler, sections)
    scene, model = jj.from_mjcf(text)(), mujoco.MjModel.from_xml_string(text)
    data, rest = mujoco.MjData(model), jnp.zeros(len(right))
    controls = lambda value: {f"m{k}": value for k in range(len(right))}
    found = jax.jit(lambda value: jj.accelerations(scene, 0.0, rest, rest, controls(value)).udot)
    for value in (-10.0, -0.25, 0.0, 0.25, 2.5, 10.0):
        data.ctrl[:] = value
        mujoco.mj_forward(model, data)
        assert_allclose(found(value), data.qfrc_actuator, rtol=1e-12, atol=1e-12)


def test_motors_are_clamped_first_by_their_control_then_by_their_force():
    scene = jj.from_mjcf(swinging(['ctrlrange="-1 3" forcerange="-2 2" gear="-3"']))()
    rest = jnp.zeros(1)
    found = jax.vmap(lambda value: jj.accelerations(scene, 0.0, rest, rest, {"m0": value}).udot[0])
    controls = jnp.array([-10.0, -0.5, 1.0, 2.5, 10.0])
    assert_allclose(found(controls), [3.0, 1.5, -3.0, -6.0, -6.0], rtol=1e-12)
    refused(
        r'`clampctrl="disable"` of `flag`',
        jj.from_mjcf,
        swinging([""]).replace('<option gravity="0 0 0"/>', '<option><flag clampctrl="disable"/></option>'),
    )


def test_a_clamped_motor_moves_in_lanes_and_has_derivatives():
    scene = jj.from_mjcf(swinging(['ctrlrange="-1 1" gear="2"']))()
    assert jj.lower(scene).operations > 0

    def end(value):
        return jj.simulate(scene, {}, t1=1.0, ts=[0.0, 1.0], inputs={"m0": value})["j0"][-1]

    # j = gear clip(m) t^2/2
    values = jnp.array([-5.0, -0.5, 0.25, 5.0])
    assert_allclose(jax.jit(jax.vmap(end))(values), np.clip(values, -1, 1), rtol=1e-6)
    for derivative in (jax.grad, jax.jacfwd):
        assert_allclose([derivative(end)(value) for value in (0.25, 5.0)], [1.0, 0.0], atol=1e-6)
