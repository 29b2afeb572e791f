"""Supported contents of MJCF elements, and the defaults of their classes.

Source: the XML reference of MuJoCo's documentation, version 3.
"""

from jourdain_jax.importers.xml_file import Element, Holds, Part, XmlFile

_PLACE = "pos quat axisangle xyaxes zaxis euler"
_CONTACT = (
    "contype conaffinity condim group priority friction solmix solref solimp margin gap user fitscale"
    " fluidcoef"
)
# actuators whose defaults also apply to the attributes of `motor`
_ACTUATORS = {"general", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle"}
_IDLE = "camera light visual statistic size sensor keyframe custom contact texture material hfield skin"
_SOFT = "class solref solimp"
_SWITCH, _RANGED = ("true", "false"), ("true", "false", "auto")
# Supported contents of elements, and attributes of their classes; all others raise an error. `idle` contents
# concern contacts, limits, drawing, and MuJoCo's own computation.
TABLE = {
    "mujoco": Holds(
        "model", many="compiler option default worldbody asset actuator equality include", listed=_IDLE
    ),
    "compiler": Holds(
        "angle eulerseq inertiafromgeom meshdir assetdir autolimits",
        idle=(
            "texturedir strippath fusestatic discardvisual usethread saveinertial convexhull "
            "exactmeshinertia fitaabb conflict lengthrange"
        ),
        off={
            "coordinate": "local",
            "boundmass": "0",
            "boundinertia": "0",
            "settotalmass": "-1",
            "balanceinertia": "false",
            "inertiagrouprange": "0 5",
            "alignfree": "false",
        },
        words={"angle": ("degree", "radian"), "inertiafromgeom": _RANGED, "autolimits": _SWITCH},
    ),
    "option": Holds(
        "gravity",
        one="flag",
        idle=(
            "timestep apirate impratio tolerance ls_tolerance noslip_tolerance ccd_tolerance mpr_tolerance "
            "o_margin o_solref o_solimp o_friction magnetic wind integrator cone jacobian solver iterations "
            "ls_iterations noslip_iterations ccd_iterations mpr_iterations sdf_iterations sdf_initpoints "
            "sleep_tolerance"
        ),
        off={"density": "0", "viscosity": "0", "actuatorgroupdisable": ""},
    ),
    "include": Holds("file"),
    "flag": Holds(
        "gravity",
        idle=(
            "constraint equality frictionloss limit contact warmstart filterparent refsafe sensor midphase "
            "eulerdamp autoreset nativeccd island multiccd energy invdiscrete sleep"
        ),
        off=dict.fromkeys(("spring", "damper", "passive", "actuation", "clampctrl"), "enable")
        | {"fwdinv": "disable enable", "override": "disable"},
        words={"gravity": ("enable", "disable")},
    ),
    "default": Holds(
        "class",
        many="default",
        idle=(
            f"{' '.join(_ACTUATORS)} motor adhesion mesh material "
            "joint geom site camera light pair equality tendon"
        ),
    ),
    "worldbody": Holds(many="geom body site frame", listed=_IDLE),
    "frame": Holds(f"name childclass {_PLACE}", many="geom body site frame", listed=_IDLE),
    "site": Holds(f"name class {_PLACE}", idle="type size fromto material rgba group user"),
    "asset": Holds(many="mesh", idle="texture material hfield skin model"),
    "mesh": Holds(
        "name class file scale",
        idle=(
            "content_type vertex normal texcoord face refpos refquat "
            "smoothnormal maxhullvert inertia builtin params"
        ),
    ),
    "body": Holds(
        f"name childclass {_PLACE}",
        one="inertial",
        many="joint freejoint geom body site frame",
        idle="user sleep",
        listed=_IDLE,
        off={"mocap": "false", "gravcomp": "0"},
    ),
    "inertial": Holds(f"mass diaginertia fullinertia {_PLACE}"),
    "joint": Holds(
        "name class type pos axis damping stiffness springref ref range",
        idle="group user margin limited solreflimit solimplimit solreffriction solimpfriction",
        off={
            "armature": "0",
            "frictionloss": "0",
            "springdamper": "0 0",
            "actuatorgravcomp": "false",
            "actuatorfrclimited": "false auto",
            "actuatorfrcrange": "0 0",
        },
    ),
    "freejoint": Holds("name", idle="group", off={"align": "false auto"}),
    "geom": Holds(
        f"name class type size fromto mass density rgba mesh {_PLACE}",
        idle=f"material hfield {_CONTACT}",
        off={"shellinertia": "false", "fluidshape": "none"},
    ),
    "actuator": Holds(many="motor"),
    "equality": Holds(many="connect weld joint"),
    "connect": Holds("name active body1 body2 anchor", idle=_SOFT, words={"active": _SWITCH}),
    "weld": Holds(
        "name active body1 body2 anchor",
        idle=f"torquescale {_SOFT}",
        off={"relpose": "0 1 0 0 0 0 0"},
        words={"active": _SWITCH},
    ),
    "equality/joint": Holds("name active joint1 joint2 polycoef", idle=_SOFT, words={"active": _SWITCH}),
    "motor": Holds(
        "name class joint site gear ctrllimited ctrlrange forcelimited forcerange",
        idle="group user",
        words={"ctrllimited": _RANGED, "forcelimited": _RANGED},
    ),
}


class Defaults:
    """Attributes that MJCF default classes give to elements that omit them."""

    def __init__(self, file: XmlFile):
        """Read all `default` sections of the file."""
        self._file = file
        self._classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for section in file.root.findall("default"):
            if section.get("class", "main") != "main":
                raise file.fault(
                    f"the outermost `default` has the class `{section.get('class')}`, expected `main`: put "
                    "a `default` with that class into it"
                )
            self._read(section, "main", {})

    def _read(self, section: Element, name: str, inherited: dict[str, dict[str, str]]) -> None:
        known, motor = {kind: dict(attributes) for kind, attributes in inherited.items()}, TABLE["motor"]
        kinds = [element.tag for element in section if element.tag != "default"]
        if twice := next((kind for kind in kinds if kinds.count(kind) > 1), None):
            raise self._file.fault(f"the class `{name}` defines `{twice}` twice, expected once")
        for element in section:
            if element.tag != "default":
                self._file.check_text(element, f"`{element.tag}` of the class `{name}`")
                known[element.tag] = known.get(element.tag, {}) | dict(element.attrib)
            if element.tag in _ACTUATORS:
                shared = {
                    name: value
                    for name, value in element.attrib.items()
                    if name in f"{motor.read} {motor.idle}".split()
                }
                known["motor"] = known.get("motor", {}) | shared
        self._classes[name] = self._classes.get(name, {}) | known
        for element in section.findall("default"):
            inner = element.get("class")
            if not inner:
                raise self._file.fault(f"a `default` inside the class `{name}` has no `class`; give it one")
            if inner in self._classes:
                raise self._file.fault(f"two `default` elements have the class `{inner}`; give each its own")
            self._read(element, inner, known)

    def of(self, element: Element, childclass: str | None, what: str) -> Part:
        """Return the element after checking it. Missing attributes come from its class, or else from the
        class of the enclosing bodies.
        """
        name = element.get("class") or childclass or "main"
        if name not in self._classes:
            raise self._file.fault(f"{what} has the class `{name}`, which no `default` defines")
        found = self._classes[name].get(element.tag, {}) | dict(element.attrib)
        self._file.check_attributes(element.tag, found, what)
        return Part(self._file, what, element, found)


def all_of(file: XmlFile, path: str) -> Part:
    """Return all sections at a path merged into one. If several of them have the same attribute, the last
    value is used.
    """
    return Part(
        file,
        f"`{path.rpartition('/')[2]}`",
        None,
        {name: value for section in file.root.findall(path) for name, value in section.attrib.items()},
    )
