"""What diffrax solvers have in common that do something about the steps of another one."""

import diffrax
import equinox as eqx


def of_wrapped(wrapped: str, name: str) -> property:
    """A property that is that of the object in the field `wrapped`, where it has one."""

    def value(self):
        """As what is wrapped."""
        return getattr(getattr(self, wrapped), name)

    return property(value)


class WrappingSolver(diffrax.AbstractWrappedSolver):
    """Everything as `solver`, but its `init` and `step`."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    # diffrax sets `scan_kind` on a Runge-Kutta solver itself, but not through a wrapper: see `for_adjoint`
    scan_kind, term_structure, interpolation_cls = (of_wrapped("solver", name) for name in ("scan_kind", "term_structure", "interpolation_cls"))
    term_compatible_contr_kwargs, func = of_wrapped("solver", "term_compatible_contr_kwargs"), of_wrapped("solver", "func")
    order, strong_order, error_order = (of_wrapped("solver", name) for name in ("order", "strong_order", "error_order"))
    root_finder, root_find_max_steps = of_wrapped("solver", "root_finder"), of_wrapped("solver", "root_find_max_steps")  # of implicit ones


def for_adjoint(solver: diffrax.AbstractSolver, adjoint: diffrax.AbstractAdjoint) -> diffrax.AbstractSolver:
    """The solver with the loop over its stages that the adjoint can differentiate."""
    if isinstance(vars(solver).get("solver"), diffrax.AbstractSolver):
        return eqx.tree_at(lambda s: s.solver, solver, for_adjoint(solver.solver, adjoint))
    kinds = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}
    kind = next((kind for of, kind in kinds.items() if isinstance(adjoint, of)), None)
    if kind is not None and getattr(solver, "scan_kind", "none of its own") is None:
        return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
    return solver
