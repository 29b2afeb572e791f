"""Equations of special points and their derivatives, as one scalar program. Eigenvalue derivatives use it,
too.
"""

from functools import cached_property

import jax
import jax.numpy as jnp

from jourdain_jax.analysis.families.equations import SteadyEquations
from jourdain_jax.analysis.motion_derivatives import ByProgram, Sloped, differentiable
from jourdain_jax.calculus.reals import Indices
from jourdain_jax.program.derivative import derivatives
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.scene import Scene


class SpecialProgram:
    """Program for R, the residual of `F (a b) = (a b) S`, C a and C b, and their derivatives. Arguments are
    all numbers, a, b, and S by rows.
    """

    def __init__(self, scene: Scene, instant: ByProgram, of: tuple[Indices, ...]) -> None:
        graph, (rows, rates, states, of_states, places) = instant.graph, of
        x, m = [instant.columns[k] for k in states], len(states)
        given = [graph.input(f"special {k}", True) for k in range(2 * m + 4)]
        a, b, S = given[:m], given[m:-4], given[-4:]
        moved, nodes, beside = [instant.v[k] for k in (*rates, *of_states)], [instant.v[k] for k in rows], []
        for direction, p, q in ((a, S[0], S[2]), (b, S[1], S[3])):
            found = derivatives(graph, moved, dict(zip(x, direction, strict=True)))
            nodes += [
                graph.sub(f, graph.add(graph.mul(p, c), graph.mul(q, d)))
                for f, c, d in zip(found, a, b, strict=False)
            ]
            beside += found[m:]
        nodes, variables = [*nodes, *beside], [*instant.given, *given]
        self._sloped = graph, nodes, [*(instant.given[k] for k in places), *given], variables, instant.guards
        self.values, self.rows = differentiable(graph, nodes, variables), len(nodes)
        self.pulled = jax.jit(
            lambda x, w: jax.vjp(self.values, x)[1](jnp.pad(w, (0, self.rows))[: self.rows])[0]
        )

    @cached_property
    def of(self) -> Sloped:
        """Return the function that computes the equations and their derivatives with respect to z, a, b and
        S.
        """
        return Sloped(*self._sloped)


def program_of(equations: SteadyEquations) -> SpecialProgram:
    of = equations.rows, equations.rates, equations.states, equations.of_states, equations.places
    return _kept_program(equations.scene, equations.instant, tuple(tuple(part.tolist()) for part in of))


_kept_program = once_per_class(SpecialProgram)
