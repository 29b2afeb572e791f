"""What MJCF's elements and attributes mean here: read, without effect on the motion, or refused; and the defaults of its classes.

Source: the XML reference of MuJoCo's documentation, version 3.
"""

from typing import Any

from jourdain_jax.importers.xml_file import Element, XmlFile
from jourdain_jax.scene.names import nearest

_PLACE = "pos quat axisangle xyaxes zaxis euler"
_CONTACT = "contype conaffinity condim group priority friction solmix solref solimp margin gap user fitscale fluidcoef"
# attributes that are read
READ = {
    "body": f"name childclass {_PLACE}",
    "inertial": f"mass diaginertia fullinertia {_PLACE}",
    "joint": "name class type pos axis damping stiffness springref ref range",
    "freejoint": "name",
    "geom": f"name class type size fromto mass density rgba mesh {_PLACE}",
    "motor": "name class joint gear",
    "compiler": "angle eulerseq inertiafromgeom meshdir assetdir",
    "option": "gravity",
}
# attributes that move nothing here: contacts, limits, drawing, how the other engine computes
IDLE = {
    "body": "user sleep",
    "inertial": "",
    "joint": "group user margin limited solreflimit solimplimit solreffriction solimpfriction",
    "freejoint": "group",
    "geom": f"material hfield {_CONTACT}",
    "motor": "group user ctrllimited ctrlrange forcelimited forcerange",
    "compiler": "autolimits texturedir strippath fusestatic discardvisual usethread saveinertial convexhull exactmeshinertia fitaabb conflict",
    "option": "timestep apirate impratio tolerance ls_tolerance noslip_tolerance ccd_tolerance mpr_tolerance o_margin o_solref o_solimp o_friction "
    "magnetic wind integrator cone jacobian solver iterations ls_iterations noslip_iterations ccd_iterations mpr_iterations sdf_iterations "
    "sdf_initpoints actuatorgroupdisable sleep_tolerance",
}
# attributes that would move something, and the values with which they do not
OFF = {
    "body": {"mocap": "false", "gravcomp": "0"},
    "joint": {
        "armature": "0",
        "frictionloss": "0",
        "springdamper": "0 0",
        "actuatorgravcomp": "false",
        "actuatorfrclimited": "false auto",
        "actuatorfrcrange": "0 0",
    },
    "freejoint": {"align": "false auto"},
    "geom": {"shellinertia": "false", "fluidshape": "none"},
    "compiler": {
        "coordinate": "local",
        "boundmass": "0",
        "boundinertia": "0",
        "settotalmass": "-1",
        "balanceinertia": "false",
        "inertiagrouprange": "0 5",
        "alignfree": "false",
    },
    "option": {"density": "0", "viscosity": "0"},
    "flag": dict.fromkeys(("spring", "damper", "passive", "gravity", "actuation"), "enable") | {"fwdinv": "disable enable", "override": "disable"},
}
# values that an attribute may have
WORDS = {"compiler": {"angle": ("degree", "radian"), "inertiafromgeom": ("true", "false", "auto")}}
# actuators that share their defaults with `motor`, as far as it has the attribute
_ACTUATORS = {"general", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle"}
# elements that move nothing, beside those that are read
IDLE_ELEMENTS = {"camera", "light", "site", "visual", "statistic", "size", "sensor", "keyframe", "custom", "contact", "texture", "material", "hfield", "skin"}


def check_attributes(file: XmlFile, kind: str, attributes: dict[str, str], what: str) -> None:
    """A ValueError for an attribute that would move something and is not read, unless it is to be ignored; or for one with an unknown value."""
    for name, words in WORDS.get(kind, {}).items():
        if attributes.get(name, words[0]) not in words:
            raise file.fault(f"`{name}` of {what} is `{attributes[name]}`; {nearest(attributes[name], words)}")
    off = OFF.get(kind, {})
    for name, value in attributes.items():
        if name in READ.get(kind, "").split() or name in IDLE.get(kind, "").split():
            continue
        if kind == "flag" and name not in off:
            continue  # of the other engine's solver
        if name in off and _is_off(value, off[name]):
            continue
        file.refuse(name, f'`{name}="{value}"` of {what}')


def _is_off(value: str, off: str) -> bool:
    try:
        return [float(x) for x in value.split()] == [float(x) for x in off.split()]
    except ValueError:
        return value in off.split()


class Defaults:
    """Attributes that classes of MJCF give to elements that do not state them."""

    def __init__(self, file: XmlFile):
        """Reads all `default` sections of the file."""
        self._file = file
        self._classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for section in file.root.findall("default"):
            if section.get("class", "main") != "main":
                raise file.fault(f"the outermost `default` is of the class `{section.get('class')}`, expected `main`: put a `default` of that class into it")
            self._read(section, "main", {})

    def _read(self, section: Element, name: str, inherited: dict[str, dict[str, str]]) -> None:
        known = {kind: dict(attributes) for kind, attributes in inherited.items()}
        for element in section:
            if element.tag != "default":
                known[element.tag] = known.get(element.tag, {}) | dict(element.attrib)
            if element.tag in _ACTUATORS:
                shared = {name: value for name, value in element.attrib.items() if name in f"{READ['motor']} {IDLE['motor']}".split()}
                known["motor"] = known.get("motor", {}) | shared
        self._classes[name] = self._classes.get(name, {}) | known
        for element in section.findall("default"):
            inner = element.get("class")
            if not inner:
                raise self._file.fault(f"a `default` inside the class `{name}` has no `class`; give it one")
            self._read(element, inner, known)

    def of(self, element: Element, childclass: str | None, what: str) -> dict[str, str]:
        """The attributes of an element, completed by its class, or else by that of the bodies around it."""
        name = element.get("class") or childclass or "main"
        if name not in self._classes:
            raise self._file.fault(f"{what} is of the class `{name}`, which no `default` states")
        return self._classes[name].get(element.tag, {}) | dict(element.attrib)


def attributes_of(file: XmlFile, tag: str) -> dict[str, Any]:
    """The attributes of all sections of a kind, the last counts; checked."""
    found: dict[str, str] = {}
    for section in file.root.findall(tag):
        found |= dict(section.attrib)
    check_attributes(file, tag, found, f"`{tag}`")
    return found
