"""SymPy's `KanesMethod`, printed to C after common subexpressions, compiled by the system's compiler,
integrated by SciPy.

SciPy's integrators take a Python function and no `LowLevelCallable`, so each evaluation costs one call
through ctypes. `scipy.integrate.ode` runs Hairer's DOP853 and ODEPACK's LSODA with their loops over steps
compiled; `solve_ivp`, whose loop is Python, is measured too.
"""

import ctypes

import numpy as np

from work_precision_cases import kane
from work_precision_cases.curve import Curve, Prepared, Solved
from work_precision_cases.peer_c import library_of

try:
    import scipy.integrate
except ImportError:
    scipy = None

MISSING = "SymPy or SciPy cannot be imported, so this peer is not measured; `pip install sympy scipy`"
FLAGS = ("-O3", "-march=native", "-ffast-math", "-shared", "-fPIC")
TOLERANCES = tuple(10.0**-k for k in range(4, 14))
MOST_STEPS = 1_000_000


def c_source(equations: kane.KaneEquations):
    """`void rates(double t, const double *y, double *dy)`: everything after common subexpressions, the
    symmetric system solved in closed form.
    """
    sp, formed, n, m = kane.sp, equations.kane, len(equations.q), len(equations.kane.u)
    y = sp.symbols(f"y:{n + m}")
    plain = dict(zip([*equations.q, *formed.u], y, strict=True))
    lower = ((i, j) for i in range(m) for j in range(i + 1))
    entries = {at: formed.mass_matrix[at] for at in lower if formed.mass_matrix[at] != 0}
    places = {at: sp.Symbol(f"M{at[0]}{at[1]}") for at in entries}
    forces = sp.symbols(f"f:{m}")
    matrix = sp.Matrix(m, m, lambda i, j: places.get((max(i, j), min(i, j)), 0))
    targets = [*(f"dy[{i}]" for i in range(n)), *map(str, places.values()), *map(str, forces)]
    shared, found = sp.cse(
        [sp.sympify(e).subs(plain) for e in (*equations.qdot, *entries.values(), *formed.forcing)],
        sp.numbered_symbols("s"),
    )
    solving, solved = sp.cse(list(matrix.LUsolve(sp.Matrix(forces))), sp.numbered_symbols("z"))
    targets += [*(name for name, _ in solving), *(f"dy[{n + i}]" for i in range(m))]
    values = [*(value for _, value in shared), *found, *(value for _, value in solving), *solved]
    names = [*(name for name, _ in shared), *targets]
    lines = [f"const double {name} = {value!r};" for name, value in equations.parameters.items()]
    lines += [f"const double y{i} = y[{i}];" for i in range(n + m)]
    for name, value in zip(map(str, names), values, strict=True):
        lines.append(f"{'const double ' * (name[:2] != 'dy')}{name} = {sp.ccode(value)};")
    body = "\n    ".join(lines)
    return f"#include <math.h>\nvoid rates(double t, const double *y, double *dy) {{\n    {body}\n}}\n"


def compiled(source):
    """The shared library; NotApplicable without a C compiler."""
    library = library_of(source, FLAGS)
    library.rates.argtypes, library.rates.restype = [ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p], None
    return library


_made: dict[str, tuple] = {}


def _equations(problem):
    if scipy is None or kane.sp is None:
        raise ImportError(MISSING)
    if problem.name not in _made:
        equations = kane.SCENES[problem.name](problem.scene)
        _made[problem.name] = equations, compiled(c_source(equations))
    return _made[problem.name]


def callback(library, size):
    """The rates as SciPy calls them; every integrator of SciPy copies what it is given, so that one output
    array serves.
    """
    out = np.empty(size)
    function, to = library.rates, out.__array_interface__["data"][0]

    def rates(t, y):
        function(t, y.__array_interface__["data"][0], to)
        return out

    return rates


def _by_ode(name):
    def prepare(problem) -> Prepared:
        equations, library = _equations(problem)
        start = equations.from_minimal(problem.minimal_start)
        rates = callback(library, len(start))

        def run(tolerance):
            # the state that SciPy hands over is contiguous float64
            solver = scipy.integrate.ode(rates).set_integrator(
                name, rtol=tolerance, atol=tolerance, nsteps=MOST_STEPS
            )
            solver.set_initial_value(start, 0.0)
            return solver.integrate(problem.end), "" if solver.successful() else "SciPy says that it failed"

        return Prepared(run, lambda raw: Solved(y=equations.to_minimal(raw[0]), failed=raw[1]))

    return prepare


def curves(problem, quick=False) -> list[Curve]:
    """Those of the problem: the disc and the sleigh."""
    if problem.name not in kane.SCENES:
        return []
    ways = {"DOP853": "dop853"} if quick else {"DOP853": "dop853", "LSODA": "lsoda"}
    used = ("sympy", "scipy", "numpy")
    return [
        Curve(f"SymPy to C, SciPy ode {name}", TOLERANCES, _by_ode(way), used) for name, way in ways.items()
    ]
