"""Park a car with a trailer: less effort, by IPOPT through opty."""

import numpy as np
import sympy
from opty import Problem
from opty.utils import create_objective_function
from park_by_casadi import car, casadi, end, f, lowered, n, parked, x
from sympy.physics.mechanics import dynamicsymbols

found, t, step = lowered.expressions(), dynamicsymbols._t, end / n  # "d_x": rate of x
states, pushes = [dynamicsymbols(name[2:]) for name in found], dynamicsymbols("drive steer_torque")
scaled = zip((*states, *pushes), (1,) * 7 + (1000, 100), strict=True)
named = {sympy.Symbol(str(s.func)): scale * s for s, scale in scaled}
equations = sympy.Matrix(
    [s.diff(t) - rate.xreplace(named) for s, rate in zip(states, found.values(), strict=True)]
)
ends = [s.func(0) for s in states] + [s.func(end) + 2.5 * (k == 1) for k, s in enumerate(states)]
bounds = {states[3]: (-0.6, 0.6)} | dict.fromkeys((states[2], states[4], *pushes), (-1, 1))
effort = sympy.Integral(pushes[0] ** 2 + pushes[1] ** 2, t)
problem = Problem(
    *create_objective_function(effort, states, pushes, (), n + 1, step, time_symbol=t),
    equations,
    states,
    n + 1,
    step,
    instance_constraints=ends,
    bounds=bounds,
    time_symbol=t,
    known_parameter_map={sympy.Symbol(name): float(getattr(car, name)) for name in ("base", "length")},
    integration_method="midpoint",
)
problem.add_option("print_level", 0)
solution, info = problem.solve(np.concatenate([parked.value(x), parked.value(f)]).ravel())
print(info["status_msg"], info["obj_val"], "after", step * casadi.sumsqr(parked.value(f)))
