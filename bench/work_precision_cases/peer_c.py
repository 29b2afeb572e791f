"""Equations by hand in C: Dormand and Prince's method of order 8 as one compiled loop over steps, for one
motion or for eight side by side.

What an expert gets who writes everything for one problem and needs no derivatives: the measure of what
machine code costs. Its steps are those of the engine's Dopri8 without projection: the same tableau, norm and
control, each lane with steps of its own; lanes that have ended wait for the others of their block.
"""

import ctypes
import platform
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from baselines.hand_derived import HAND_DERIVED

from jourdain_jax.integrate.explicit_steps import DOPRI8
from work_precision_cases import kane
from work_precision_cases.curve import TOLERANCES, Curve, NotApplicable, Prepared, Solved
from work_precision_cases.peer_diffrax import BY_HAND

FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp-simd", "-shared", "-fPIC")
WIDE = "-mprefer-vector-width=512"  # of processors that have such registers
MISSING = "SymPy cannot be imported, which writes the equations by hand as C; `pip install sympy`"

MACROS = """#define EACH_LANE _Pragma("omp simd") for (int l = 0; l < W; l++)
#define UNROLLED _Pragma("GCC unroll 13")
"""
LOOP = """
static void stages(const double *restrict y, const double *restrict h, double (*restrict k)[N * W]) {
    double at[N * W], sum[W];
    rates(y, k[0]);
    UNROLLED for (int s = 1; s < S; s++) {
        for (int i = 0; i < N; i++) {
            EACH_LANE sum[l] = 0;
            UNROLLED for (int j = 0; j < s; j++)
                if (A[s][j] != 0) EACH_LANE sum[l] += A[s][j] * k[j][i * W + l];
            EACH_LANE at[i * W + l] = y[i * W + l] + h[l] * sum[l];
        }
        rates(at, k[s]);
    }
}

/* Motions from `start` to the time `end`, both arrays (lanes, N); how many steps were tried. */
long solve(double tolerance, double end, long lanes, const double *start, double *found) {
    long tried = 0;
    for (long first = 0; first < lanes; first += W) {
        double y[N * W], next[N * W], k[S][N * W], t[W], h[W], squares[W], change[W], error[W];
        for (int l = 0; l < W; l++) {
            const long lane = first + l < lanes ? first + l : lanes - 1;
            for (int i = 0; i < N; i++) y[i * W + l] = start[lane * N + i];
            t[l] = 0;
        }
        rates(y, k[0]);
        for (int l = 0; l < W; l++) {
            double size = 0, speed = 0;
            for (int i = 0; i < N; i++) {
                const double scale = tolerance * (1 + fabs(y[i * W + l]));
                const double a = y[i * W + l] / scale, b = k[0][i * W + l] / scale;
                size += a * a, speed += b * b;
            }
            h[l] = fmin(end, speed > 0 ? 0.01 * sqrt(size / speed) + 1e-6 : 1e-3);
        }
        for (int going = 1; going;) {
            stages(y, h, k);
            EACH_LANE squares[l] = 0;
            for (int i = 0; i < N; i++) {
                EACH_LANE change[l] = error[l] = 0;
                UNROLLED for (int j = 0; j < S; j++) {
                    if (B[j] != 0) EACH_LANE change[l] += B[j] * k[j][i * W + l];
                    if (E[j] != 0) EACH_LANE error[l] += E[j] * k[j][i * W + l];
                }
                EACH_LANE {
                    next[i * W + l] = y[i * W + l] + h[l] * change[l];
                    const double most = fmax(fabs(y[i * W + l]), fabs(next[i * W + l]));
                    const double e = h[l] * error[l] / (tolerance * (1 + most));
                    squares[l] += e * e;
                }
            }
            going = 0;
            for (int l = 0; l < W; l++) {
                if (h[l] == 0) continue;
                const double e = squares[l] / N;  /* the square of the norm */
                tried++;
                if (e <= 1) {
                    for (int i = 0; i < N; i++) y[i * W + l] = next[i * W + l];
                    t[l] += h[l];
                }
                const double factor = e > 0 ? 0.9 * pow(e, -1.0 / 16) : 10;
                h[l] = fmin(h[l] * fmin(10, fmax(0.2, factor)), end - t[l]);
                if (h[l] < 1e-14 * end) h[l] = 0;
                going |= h[l] != 0;
            }
        }
        for (int l = 0; l < W && first + l < lanes; l++)
            for (int i = 0; i < N; i++) found[(first + l) * N + i] = y[i * W + l];
    }
    return tried;
}
"""


def _rates(problem, side_by_side):
    """How many states there are, and `rates(y, f)` of all lanes: each common subexpression once, parameters
    as numbers.
    """
    sp, known = kane.sp, HAND_DERIVED[problem.name]
    if sp is None:
        raise ImportError(MISSING)
    y = sp.symbols(f"y:{len(known.coordinates) + len(known.speeds)}")
    parameters = {name: sp.Float(float(getattr(problem.scene, name)), 17) for name in known.parameters}
    xp = SimpleNamespace(sin=sp.sin, cos=sp.cos, zeros_like=lambda x: sp.Integer(0))
    qdot, vdot = known.rates(
        parameters, sp.Symbol("t"), y[: len(known.coordinates)], y[len(known.coordinates) :], xp=xp
    )
    found = [sp.sympify(x) for x in (*qdot, *vdot)]
    # sines apart from cosines: GCC makes one call of both, for which it has no vectors
    waves = (
        sorted(set().union(*(x.atoms(sp.sin, sp.cos) for x in found)), key=str) if side_by_side > 1 else []
    )
    names = dict(zip(waves, sp.symbols(f"w:{len(waves)}"), strict=True))
    shared, found = sp.cse([x.subs(names) for x in found], sp.numbered_symbols("s"))
    states = {str(x): f"y[{i} * W + l]" for i, x in enumerate(y)} | {
        str(w): f"{w}[l]" for w in names.values()
    }
    code = lambda x: re.sub(r"\b[yw]\d+\b", lambda name: states[name[0]], sp.ccode(x))
    lines = [f"double {name}[W];\n    EACH_LANE {name}[l] = {code(wave)};" for wave, name in names.items()]
    inner = [f"const double {name} = {code(value)};" for name, value in shared] + [
        f"f[{i} * W + l] = {code(value)};" for i, value in enumerate(found)
    ]
    lines.append("EACH_LANE {\n        " + "\n        ".join(inner) + "\n    }")
    return (
        len(y),
        "static void rates(const double *restrict y, double *restrict f) {\n    "
        + "\n    ".join(lines)
        + "\n}\n",
    )


def source(problem, side_by_side):
    """The whole of it."""
    (size, rates), stages = _rates(problem, side_by_side), DOPRI8.needed
    row = lambda numbers: "{" + ", ".join(repr(float(x)) for x in numbers) + "}"
    A = ", ".join(row(DOPRI8.A[i, :stages]) for i in range(stages))
    tables = (
        f"static const double A[S][S] = {{{A}}}, B[S] = {row(DOPRI8.b[:stages])}, E[S] ="
        f" {row(DOPRI8.b_error[:stages])};\n"
    )
    return (
        f"#include <math.h>\nenum {{ N = {size}, W = {side_by_side}, S = {stages}"
        f" }};\n{tables}{MACROS}{rates}{LOOP}"
    )


def library_of(source, flags) -> ctypes.CDLL:
    """C, compiled and loaded; NotApplicable without a compiler that takes it."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise NotApplicable("there is no C compiler (cc, gcc, clang)")
    with tempfile.TemporaryDirectory() as folder:
        text, library = Path(folder) / "source.c", Path(folder) / "library.so"
        text.write_text(source)
        done = subprocess.run(
            [compiler, *flags, "-o", str(library), str(text), "-lm"], capture_output=True, text=True
        )
        if done.returncode != 0:
            raise NotApplicable(f"{compiler} does not compile it: {done.stderr.strip().splitlines()[-1]}")
        return ctypes.CDLL(str(library))


def compiled(problem, side_by_side):
    """A function of a tolerance and starts, (lanes, states), that returns the states at the end, and how many
    steps were tried.
    """
    flags = (*FLAGS, WIDE) if platform.machine() in ("x86_64", "AMD64") else FLAGS
    solve = library_of(source(problem, side_by_side), flags).solve
    solve.argtypes, solve.restype = (
        [ctypes.c_double, ctypes.c_double, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p],
        ctypes.c_long,
    )

    def run(tolerance, starts):
        starts = np.ascontiguousarray(starts, float)
        found = np.empty_like(starts)
        tried = solve(tolerance, problem.end, len(starts), starts.ctypes.data, found.ctypes.data)
        return found, tried

    return run


def _alone(problem) -> Prepared:
    run, start = compiled(problem, 1), problem.minimal_start[None]

    return Prepared(
        lambda tolerance: run(tolerance, start), lambda raw: Solved(y=raw[0][0], steps=float(raw[1]))
    )


def curves(problem) -> list[Curve]:
    """Those of the problem."""
    return [Curve("C by hand, Dopri8", TOLERANCES, _alone, ("sympy",))] if problem.name in BY_HAND else []
