"""What diffrax solvers have in common that do something about the steps of another one."""

import diffrax
import equinox as eqx


class WrappingSolver(diffrax.AbstractWrappedSolver):
    """Everything as `solver`, but its `init` and `step`."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    @property
    def scan_kind(self):
        """As the wrapped solver. diffrax sets it on a Runge-Kutta solver itself, but not through a wrapper: see `for_adjoint`."""
        return self.solver.scan_kind

    @property
    def term_structure(self):
        """As the wrapped solver."""
        return self.solver.term_structure

    @property
    def interpolation_cls(self):
        """As the wrapped solver."""
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):
        """As the wrapped solver."""
        return self.solver.term_compatible_contr_kwargs

    @property
    def root_finder(self):
        """As the wrapped solver, where it is implicit."""
        return self.solver.root_finder

    @property
    def root_find_max_steps(self):
        """As the wrapped solver, where it is implicit."""
        return self.solver.root_find_max_steps

    def order(self, terms):
        """As the wrapped solver. `terms` as in diffrax."""
        return self.solver.order(terms)

    def strong_order(self, terms):
        """As the wrapped solver. `terms` as in diffrax."""
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        """As the wrapped solver. `terms` as in diffrax."""
        return self.solver.error_order(terms)

    def func(self, terms, t0, y0, args):
        """As the wrapped solver. `terms`, `t0`, `y0`, `args`: as in diffrax."""
        return self.solver.func(terms, t0, y0, args)


def for_adjoint(solver: diffrax.AbstractSolver, adjoint: diffrax.AbstractAdjoint) -> diffrax.AbstractSolver:
    """The solver with the loop over its stages that the adjoint can differentiate."""
    if isinstance(vars(solver).get("solver"), diffrax.AbstractSolver):
        return eqx.tree_at(lambda s: s.solver, solver, for_adjoint(solver.solver, adjoint))
    kinds = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}
    kind = next((kind for of, kind in kinds.items() if isinstance(adjoint, of)), None)
    if kind is not None and getattr(solver, "scan_kind", "none of its own") is None:
        return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
    return solver
