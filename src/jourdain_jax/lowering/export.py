"""A lowered scene for people: a summary of what was done, and the program as Python, C, SymPy or LaTeX (functions of a `Lowered`)."""

import re

import numpy as np

from jourdain_jax.program.source import PYTHON, C, statements, sympy_expressions


def summary(lowered) -> str:
    """Operations after each step, what was dropped and why, the privileged speeds, pivots and guards."""
    fewer = ", ".join(lowered.held)
    lines = [
        f"Lowered equations of {lowered.scene_name}: {lowered.operations} operations for {len(lowered.qdot)} rates and {len(lowered.ydot)} accelerations",
        *(f"  {stage.operations:6d} operations: {stage.name}" for stage in lowered.stages),
        *_speeds(lowered),
        f"  left out of the accelerations, which do not depend on them: {fewer or 'nothing'}",
        f"  recoverable by quadrature, as nothing else depends on them: {', '.join(lowered.coordinates[i] for i in lowered.recoverable()) or 'none'}",
        f"  computed once per motion, from parameters alone: {len(lowered.fixed)} numbers",
        f"  pivots that are watched: {len(lowered.pivots)}; signs that are relied on: {len(lowered.guards)}",
        f"  way: {lowered.way}; {lowered.seconds:.2f} s",
    ]
    return "\n".join(lines)


def _speeds(lowered) -> list[str]:
    if lowered.projected_u:
        return [f"  speeds, all integrated, with rows kept by multipliers: {', '.join(lowered.speeds)}"]
    return [
        f"  privileged speeds: {', '.join(lowered.speeds[i] for i in lowered.independent) or 'none'}",
        f"  dependent speeds, eliminated: {', '.join(lowered.speeds[i] for i in lowered.dependent) or 'none'}",
    ]


def identifiers(lowered) -> dict[int, str]:
    """A readable name for every input of the program."""
    traced = lowered.traced
    names: dict[int, str] = {}
    for nodes, name in zip(traced.parameters, lowered.parameters, strict=True):
        flat = np.ravel(nodes).tolist()
        names |= {n: _identifier(name if len(flat) == 1 else f"{name}_{i}") for i, n in enumerate(flat)}
    names |= {traced.t: "t"} | {int(n): _identifier(name) for n, name in zip(traced.q, lowered.coordinates, strict=True)}
    names |= {int(n): _identifier(name) for n, name in zip(traced.u, lowered.speeds, strict=True)}
    return names | {int(n): _identifier(f"{name}_input" if name in names.values() else name) for n, name in zip(traced.inputs, lowered.inputs, strict=True)}


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name.strip("."))


def results(lowered) -> dict[str, int]:
    """Name -> node of every rate."""
    rates = {f"d_{_identifier(name)}": n for name, n in zip(lowered.coordinates, lowered.qdot, strict=True)}
    return rates | {f"d_{_identifier(lowered.speeds[i])}": n for i, n in zip(lowered.independent, lowered.ydot, strict=True)}


def python_source(lowered) -> str:
    """Two functions: what depends on parameters alone, and the rates."""
    names, rates = identifiers(lowered), results(lowered)
    parameters = [names[int(n)] for nodes in lowered.traced.parameters for n in np.ravel(nodes)]
    first, fixed = statements(lowered.graph, lowered.fixed, names, PYTHON, "c")
    known = names | {n: f"k{i}" for i, n in enumerate(lowered.fixed)}
    second, outputs = statements(lowered.graph, list(rates.values()), known, PYTHON)
    state = ", ".join(["t", *(_identifier(c) for c in lowered.coordinates), *(_identifier(lowered.speeds[i]) for i in lowered.independent)])
    extra = "".join(f", {known[int(n)]}" for n in lowered.traced.inputs)
    unpack = [f"    {', '.join(f'k{i}' for i in range(len(fixed)))}{',' if len(fixed) == 1 else ''} = fixed"] if fixed else []
    return "\n".join(
        [
            "import math",
            "",
            "",
            f"def fixed({', '.join(parameters)}):",
            f'    """What depends on the parameters of {lowered.scene_name} alone."""',
            *first,
            f"    return ({', '.join(fixed)}{',' if len(fixed) == 1 else ''})",
            "",
            "",
            f"def rates(fixed, {state}{extra}):",
            f'    """{", ".join(rates)}"""',
            *unpack,
            *second,
            f"    return ({', '.join(outputs)},)",
            "",
        ]
    )


def c_source(lowered, name: str = "rates") -> str:
    """One C function `void rates(const double *parameters, double t, const double *q, const double *y, const double *inputs, double *out)`."""
    traced = lowered.traced
    flat = [int(n) for nodes in traced.parameters for n in np.ravel(nodes)]
    places = {n: f"parameters[{i}]" for i, n in enumerate(flat)} | {traced.t: "t"}
    places |= {int(n): f"q[{i}]" for i, n in enumerate(traced.q)} | {int(traced.u[k]): f"y[{i}]" for i, k in enumerate(lowered.independent)}
    places |= {int(n): f"inputs[{i}]" for i, n in enumerate(traced.inputs)}
    rates = results(lowered)
    lines, outputs = statements(lowered.graph, list(rates.values()), places, C)
    return "\n".join(
        [
            "#include <math.h>",
            "",
            "static inline double sign(double x) { return (x > 0) - (x < 0); }",
            "",
            f"/* {lowered.scene_name}: out = {', '.join(rates)} */",
            f"void {name}(const double *parameters, double t, const double *q, const double *y, const double *inputs, double *out) {{",
            *lines,
            *(f"    out[{i}] = {text};  /* {rate} */" for i, (rate, text) in enumerate(zip(rates, outputs, strict=True))),
            "}",
            "",
        ]
    )


def expressions(lowered) -> dict:
    """Name -> SymPy expression of every rate, in the parameters and the state; needs SymPy."""
    rates = results(lowered)
    return dict(zip(rates, sympy_expressions(lowered.graph, list(rates.values()), identifiers(lowered)), strict=True))


def latex(lowered) -> str:
    """One equation per rate, for an `align` environment; needs SymPy."""
    import sympy

    def dotted(name: str) -> str:
        return rf"\dot{{{sympy.latex(sympy.Symbol(name.removeprefix('d_')))}}}"

    return " \\\\\n".join(f"{dotted(name)} &= {sympy.latex(value)}" for name, value in expressions(lowered).items())
