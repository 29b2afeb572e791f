"""SymPy's `KanesMethod`, printed to C after common subexpressions, compiled by the system's compiler, integrated by SciPy.

SciPy's integrators take a Python function and no `LowLevelCallable`, so each evaluation costs one call through ctypes. `scipy.integrate.ode` runs
Hairer's DOP853 and ODEPACK's LSODA with their loops over steps compiled; `solve_ivp`, whose loop is Python, is measured too.
"""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from work_precision_cases import kane
from work_precision_cases.curve import Curve, NotApplicable, Prepared, Solved
from work_precision_cases.problem import Problem

try:
    import scipy.integrate
except ImportError:
    scipy = None

MISSING = "SymPy or SciPy cannot be imported, so this peer is not measured; `pip install sympy scipy`"
FLAGS = ("-O3", "-march=native", "-ffast-math", "-shared", "-fPIC")
TOLERANCES = tuple(10.0**-k for k in range(4, 14))
MOST_STEPS = 1_000_000
# Evaluations one after another without Python between: each starts from what the last one gave, so that none is left out.
_REPEAT = """
void repeat(long count, int states, double *y, double *dy) {
    for (long k = 0; k < count; ++k) {
        rates(0.0, y, dy);
        for (int i = 0; i < states; ++i) y[i] += 1e-9 * dy[i];
    }
}
"""


def c_source(equations: kane.KaneEquations) -> str:
    """`void rates(double t, const double *y, double *dy)`: everything after common subexpressions, the symmetric system solved in closed form."""
    sp, n, m = kane.sp, len(equations.q), len(equations.u)
    y = sp.symbols(f"y:{n + m}")
    plain = dict(zip([*equations.q, *equations.u], y, strict=True))
    entries = {(i, j): equations.mass_matrix[i, j] for i in range(m) for j in range(i + 1) if equations.mass_matrix[i, j] != 0}
    places = {at: sp.Symbol(f"M{at[0]}{at[1]}") for at in entries}
    forces = sp.symbols(f"f:{m}")
    matrix = sp.Matrix(m, m, lambda i, j: places.get((max(i, j), min(i, j)), 0))
    targets = [*(f"dy[{i}]" for i in range(n)), *map(str, places.values()), *map(str, forces)]
    shared, found = sp.cse([sp.sympify(e).subs(plain) for e in (*equations.qdot, *entries.values(), *equations.forcing)], sp.numbered_symbols("s"))
    solving, solved = sp.cse(list(matrix.LUsolve(sp.Matrix(forces))), sp.numbered_symbols("z"))
    code = sp.ccode
    lines = [f"const double {name} = {value!r};" for name, value in ((str(s), v) for s, v in equations.parameters.items())]
    lines += [f"const double y{i} = y[{i}];" for i in range(n + m)]
    lines += [f"const double {name} = {code(value)};" for name, value in shared]
    lines += [f"{'' if target.startswith('dy') else 'const double '}{target} = {code(value)};" for target, value in zip(targets, found, strict=True)]
    lines += [f"const double {name} = {code(value)};" for name, value in solving]
    lines += [f"dy[{n + i}] = {code(value)};" for i, value in enumerate(solved)]
    return "#include <math.h>\nvoid rates(double t, const double *y, double *dy) {\n    " + "\n    ".join(lines) + "\n}\n" + _REPEAT


def compiled(source: str):
    """The shared library; NotApplicable without a C compiler."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise NotApplicable("there is no C compiler (cc, gcc, clang)")
    folder = Path(tempfile.mkdtemp())
    (folder / "rates.c").write_text(source)
    subprocess.run([compiler, *FLAGS, "-o", str(folder / "rates.so"), str(folder / "rates.c"), "-lm"], check=True)
    library = ctypes.CDLL(str(folder / "rates.so"))
    shutil.rmtree(folder)  # loaded already
    library.rates.argtypes, library.rates.restype = [ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p], None
    library.repeat.argtypes, library.repeat.restype = [ctypes.c_long, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p], None
    return library


_made: dict[str, tuple] = {}


def _equations(problem: Problem) -> tuple:
    if scipy is None or kane.sp is None:
        raise ImportError(MISSING)
    if problem.name not in _made:
        equations = kane.SCENES[problem.name](problem.scene)
        _made[problem.name] = equations, compiled(c_source(equations))
    return _made[problem.name]


def callback(library, size: int):
    """The rates as SciPy calls them; every integrator of SciPy copies what it is given, so that one output array serves."""
    out = np.empty(size)
    function, to = library.rates, out.__array_interface__["data"][0]
    count = [0]

    def rates(t, y):
        count[0] += 1
        function(t, y.__array_interface__["data"][0], to)
        return out

    return rates, count


def _by_ode(name: str):
    def prepare(problem: Problem) -> Prepared:
        equations, library = _equations(problem)
        start = equations.from_minimal(problem.minimal_start)
        rates, count = callback(library, len(start))

        def run(tolerance: float):
            count[0] = 0
            # the state that SciPy hands over is contiguous float64
            solver = scipy.integrate.ode(rates).set_integrator(name, rtol=tolerance, atol=tolerance, nsteps=MOST_STEPS)
            solver.set_initial_value(start, 0.0)
            return solver.integrate(problem.end), count[0], "" if solver.successful() else "SciPy says that it failed"

        return Prepared(run, lambda raw: Solved(y=equations.to_minimal(raw[0]), rhs_evaluations=float(raw[1]), failed=raw[2]))

    return prepare


def _by_solve_ivp(problem: Problem) -> Prepared:
    equations, library = _equations(problem)
    start = equations.from_minimal(problem.minimal_start)
    rates, _ = callback(library, len(start))

    def copied(t, y):
        return rates(t, np.ascontiguousarray(y)).copy()

    def run(tolerance: float):
        return scipy.integrate.solve_ivp(copied, (0.0, problem.end), start, method="DOP853", rtol=tolerance, atol=tolerance, t_eval=[problem.end])

    def read(found):
        return Solved(
            y=equations.to_minimal(found.y[:, -1]), rhs_evaluations=float(found.nfev), failed="" if found.success else found.message
        )  # solve_ivp raises tolerances below 2e-14

    return Prepared(run, read)


def curves(problem: Problem, quick: bool = False) -> list[Curve]:
    """Those of the problem: the disc, the sleigh and the axle."""
    if problem.name not in kane.SCENES:
        return []
    used = ("sympy", "scipy", "numpy")
    found = [Curve("SymPy to C, SciPy ode DOP853", "peer", TOLERANCES, "tolerance", _by_ode("dop853"), used)]
    if quick:
        return found
    return [
        *found,
        Curve("SymPy to C, SciPy ode LSODA", "peer", TOLERANCES, "tolerance", _by_ode("lsoda"), used),
        Curve("SymPy to C, SciPy solve_ivp DOP853", "peer", TOLERANCES, "tolerance", _by_solve_ivp, used),
    ]
