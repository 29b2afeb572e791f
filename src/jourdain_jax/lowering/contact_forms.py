"""Simplify switching contacts by normal forms. Their responses are simplified once; loads, events, resets and
starts then use the simplified nodes.
"""

from collections.abc import Callable

import numpy as np

from jourdain_jax.program.polynomial import NormalForms
from jourdain_jax.structure.trace import TracedScene

MOST_TERMS = (8, 60)  # term limits to try


def simplify_contacts(traced: TracedScene, forms: Callable[[int], NormalForms]) -> None:
    """Replace `responses` by normal forms. Responses at later states, which are functions of earlier
    responses, are replaced, too. `forms`: function from a maximum number of terms to normal forms.
    """
    g, at = traced.graph, traced.at
    state = [*traced.q.tolist(), *traced.u.tolist(), *traced.inputs.tolist()]
    first, *later = (row[len(state) :] for row in at.responses.tolist())
    normal = min([first, *(forms(most).all_simplified(first) for most in MOST_TERMS)], key=g.operations)
    simple = dict(zip(first, normal, strict=True))
    for row, nodes in zip(at.responses[1:, : len(state)].tolist(), later, strict=True):
        now = dict(zip(state, g.substituted(row, simple), strict=True))
        simple |= dict(zip(nodes, g.substituted(normal, now), strict=True))
    loads = at.force, at.torque, at.direct, at.power
    for x in (*loads, at.events, at.resets, at.slip_turns, at.held, at.start):
        x[...] = np.array(g.substituted(x.ravel().tolist(), simple), np.int64).reshape(x.shape)
