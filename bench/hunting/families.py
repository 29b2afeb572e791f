"""All families of generated cases, in one list."""

from hunting import (
    bodies,
    contacts,
    events,
    gradients,
    linkages,
    oscillators,
    pendulums,
    refusals,
    short_features,
    sliders,
    transitions,
    uses,
)

FAMILIES = (
    *linkages.FAMILIES,
    *sliders.FAMILIES,
    *pendulums.FAMILIES,
    *events.FAMILIES,
    *transitions.FAMILIES,
    *contacts.FAMILIES,
    *oscillators.FAMILIES,
    *bodies.FAMILIES,
    *uses.FAMILIES,
    *short_features.FAMILIES,
    *refusals.FAMILIES,
    *gradients.FAMILIES,
)


def family(name):
    """The family with this name; ValueError where there is none."""
    for found in FAMILIES:
        if found.name == name:
            return found
    raise ValueError(f"there is no family `{name}`; known: {', '.join(f.name for f in FAMILIES)}")
