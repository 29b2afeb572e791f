"""Show a lowered scene: a summary, and the program as Python, C, SymPy or LaTeX."""

import re

import numpy as np

from jourdain_jax.program.source import PYTHON, C, statements, sympy_expressions

_KEYWORDS = """auto case char const default do double enum extern float goto inline int long register restrict
short signed sizeof static struct switch typedef union unsigned void volatile"""
_IN_C = C.names.union(_KEYWORDS.split())
_ARGUMENTS = ("parameters", "t", "coordinates", "speeds", "inputs", "out")


def summary(lowered) -> str:
    """Return a text: number of operations after each step, omitted coordinates and constraints, JAX calls
    with reasons, independent speeds, parameters with units, pivots and guards.
    """
    lines = [
        (
            f"Lowered equations of {lowered.scene_name}: {lowered.operations} operations for"
            f" {len(lowered.qdot)} rates and {len(lowered.ydot)} accelerations"
        ),
        *(f"  {stage.operations:6d} operations: {stage.name}" for stage in lowered.stages),
        *_speeds(lowered),
        f"  omitted, because accelerations do not depend on them: {', '.join(lowered.held) or 'nothing'}",
        *(f"  kept as a JAX call, without scalar form: {reason}" for reason in lowered.calls),
        *([f"  redundant constraints omitted: {', '.join(lowered.left_out)}"] if lowered.left_out else []),
        f"  parameters, kept as inputs (SI units and radians): {_parameters(lowered) or 'none'}",
        (
            f"  computed once per motion, from parameters only: {len(lowered.fixed)} "
            f"number{'' if len(lowered.fixed) == 1 else 's'}"
        ),
        (
            "  monitored pivots, which must not vanish: "
            f"{_shown(lowered, [_alone(lowered.graph, n) for n in lowered.pivots])}"
        ),
        f"  monitored guards, which must stay positive: {_shown(lowered, lowered.guards)}",
        f"  strategy: {lowered.way}; {lowered.seconds:.2f} s",
    ]
    return "\n".join(lines)


def _parameters(lowered) -> str:
    named = [(_identifier(name), unit) for name, unit in zip(lowered.parameters, lowered.units, strict=True)]
    return ", ".join(f"{name} ({unit})" if unit else name for name, unit in named)


def _shown(lowered, nodes) -> str:
    """Return a text of the short nodes as expressions (if at most 8 nodes, of at most 60 characters each),
    and the number of other nodes.
    """
    names = identifiers(lowered)
    few = [n for n in nodes if len(nodes) <= 8 and not lowered.graph.calls([n])]
    written = [statements(lowered.graph, [n], names, PYTHON) for n in few]
    short = [text.replace("math.", "") for lines, (text,) in written if not lines and len(text) <= 60]
    more = len(nodes) - len(short)
    others = [f"{more} longer expression{'s' if more > 1 else ''}"] if more else []
    return ", ".join([*short, *others]) or "none"


def _alone(graph, pivot: int) -> int:
    """Return a pivot without its scale or sign function: the varying factor, or the argument of the sign."""
    args = graph.args[pivot]
    if graph.op[pivot] not in ("mul", "sign"):
        return pivot
    return next((a for a in args if graph.varies[a]), args[0])


def _speeds(lowered) -> list[str]:
    if lowered.projected_u:
        return [
            f"  all speeds are integrated, with multipliers for the constraints: {', '.join(lowered.speeds)}"
        ]
    return [
        f"  independent speeds: {', '.join(lowered.speeds[i] for i in lowered.independent) or 'none'}",
        (
            "  dependent speeds, eliminated: "
            f"{', '.join(lowered.speeds[i] for i in lowered.dependent) or 'none'}"
        ),
    ]


def identifiers(lowered) -> dict[int, str]:
    """Return a unique, readable name for each input node of the program."""
    traced = lowered.traced
    named = [(traced.t, "t")]
    for nodes, name in zip(traced.parameters, lowered.parameters, strict=True):
        flat = np.ravel(nodes).tolist()
        named += [(n, name if len(flat) == 1 else f"{name}_{i}") for i, n in enumerate(flat)]
    for nodes, given in (
        (traced.q, lowered.coordinates),
        (traced.u, lowered.speeds),
        (traced.inputs, lowered.inputs),
    ):
        named += zip(nodes.tolist(), given, strict=True)
    names: dict[int, str] = {}
    taken = {"fixed", "math", "sign"}
    for n, name in named:
        own = _identifier(name)
        while own in taken:
            own += "_input" if n in traced.inputs and not own.endswith("_input") else "_"
        names[n] = own
        taken.add(own)
    return names


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name.strip("."))


def results(lowered) -> dict[str, int]:
    """Return the nodes of all rates, by name."""
    rates = {f"d_{_identifier(name)}": n for name, n in zip(lowered.coordinates, lowered.qdot, strict=True)}
    return rates | {
        f"d_{_identifier(lowered.speeds[i])}": n
        for i, n in zip(lowered.independent, lowered.ydot, strict=True)
    }


def _prefix(letter: str, names) -> str:
    """Return a prefix for numbered names such that none of these is among `names`."""
    taken = any(re.fullmatch(rf"{letter}\d+", name) for name in names)
    return _prefix(letter + "_", names) if taken else letter


def python_source(lowered) -> str:
    """Return Python source of two functions: one for values that depend on parameters only, one for the
    rates.
    """
    names, rates = identifiers(lowered), results(lowered)
    c, k, s = (_prefix(letter, names.values()) for letter in "cks")
    parameters = [names[int(n)] for nodes in lowered.traced.parameters for n in np.ravel(nodes)]
    used = lowered.graph.fixed(rates.values())
    first, fixed = statements(lowered.graph, used, names, PYTHON, c)
    known = names | {n: f"{k}{i}" for i, n in enumerate(used)}
    second, outputs = statements(lowered.graph, list(rates.values()), known, PYTHON, s)
    given = [
        lowered.traced.t,
        *lowered.traced.q,
        *(lowered.traced.u[i] for i in lowered.independent),
        *lowered.traced.inputs,
    ]
    state = ", ".join(names[int(n)] for n in given)
    signed = any("sign(" in text for text in (*first, *fixed, *second, *outputs))
    signs = ["", "def sign(x):", "    return 1.0 if x > 0 else -1.0 if x < 0 else 0.0", ""] if signed else []
    unpack = (
        [f"    {', '.join(f'{k}{i}' for i in range(len(fixed)))}{',' if len(fixed) == 1 else ''} = fixed"]
        if fixed
        else []
    )
    return "\n".join(
        [
            "import math",
            "",
            *signs,
            "",
            f"def fixed({', '.join(parameters)}):",
            (
                f'    """Values that depend only on parameters of {lowered.scene_name}: '
                f'{_parameters(lowered) or "none"}."""'
            ),
            *first,
            f"    return ({', '.join(fixed)}{',' if len(fixed) == 1 else ''})",
            "",
            "",
            f"def rates(fixed, {state}):",
            f'    """Time derivatives {", ".join(rates)}. {_conventions(lowered)}"""',
            *unpack,
            *second,
            "    return (",
            *(f"        {text},  # {rate}" for rate, text in zip(rates, outputs, strict=True)),
            "    )",
            "",
        ]
    )


def _conventions(lowered) -> str:
    """Return units and axes as a text that cannot end a docstring or comment."""
    said = lowered.conventions.replace('"', "'").replace("*/", "").rstrip()
    return said if "SI units" in said else f"SI units, radians. {said}".rstrip()


def c_source(lowered, name: str = "rates") -> str:
    """Return C source of the function `void rates(parameters, t, coordinates, speeds, inputs, out)`, which
    needs the C mathematical library.
    """
    traced, rates = lowered.traced, results(lowered)
    names = {
        n: f"{given}_" if given in _IN_C or (given in _ARGUMENTS and n != traced.t) else given
        for n, given in identifiers(lowered).items()
    }
    flat = [int(n) for nodes in traced.parameters for n in np.ravel(nodes)]
    groups = {
        "parameters": flat,
        "coordinates": traced.q.tolist(),
        "speeds": [int(traced.u[k]) for k in lowered.independent],
    }
    groups["inputs"] = [int(n) for n in traced.inputs]
    lines, outputs = statements(lowered.graph, list(rates.values()), names, C, _prefix("s", names.values()))
    used = {n for n in lowered.graph.reachable(rates.values()) if n in names}
    unused = [group for group, nodes in groups.items() if not used.intersection(nodes)]
    unused += [] if traced.t in used else ["t"]
    signs = (
        ["static inline double sign(double x) { return (x > 0) - (x < 0); }", ""]
        if any("sign(" in text for text in (*lines, *outputs))
        else []
    )
    listed = {group: ", ".join(names[n] for n in nodes) or "none" for group, nodes in groups.items()}
    return "\n".join(
        [
            "#include <math.h>",
            "",
            *signs,
            f"/* {lowered.scene_name}. {_conventions(lowered)}",
            f"   parameters: {_parameters(lowered) or 'none'}",
            *(f"   {group}: {listed[group]}" for group in ("coordinates", "speeds", "inputs")),
            f"   out, time derivatives: {', '.join(rates)} */",
            (
                f"void {name}(const double *parameters, double t, const double *coordinates, const double "
                "*speeds, const double *inputs, double *out) {"
            ),
            *(f"    (void){argument};" for argument in unused),
            *(
                f"    const double {names[n]} = {group}[{i}];"
                for group, nodes in groups.items()
                for i, n in enumerate(nodes)
                if n in used
            ),
            *lines,
            *(
                f"    out[{i}] = {text};  /* {rate} */"
                for i, (rate, text) in enumerate(zip(rates, outputs, strict=True))
            ),
            "}",
            "",
        ]
    )


def expressions(lowered) -> dict:
    """Return SymPy expressions of all rates, by name, in the parameters and the state. Requires SymPy."""
    rates = results(lowered)
    return dict(
        zip(rates, sympy_expressions(lowered.graph, list(rates.values()), identifiers(lowered)), strict=True)
    )


def latex(lowered) -> str:
    """Return the equations for an `align` environment, with numbers rounded to six digits. Requires SymPy.

    A speed that is the rate of a coordinate is written as the derivative of the coordinate.
    """
    import sympy

    names, traced = identifiers(lowered), lowered.traced
    rate_of = {int(rate): _symbol(name) for name, rate in zip(lowered.coordinates, lowered.qdot, strict=True)}
    shown = {n: _symbol(name) for n, name in names.items()}
    shown |= {int(n): _symbol(name) for n, name in zip(traced.q, lowered.coordinates, strict=True)}
    shown |= {n: rf"\dot{{{rate_of[n]}}}" for n in map(int, traced.u) if n in rate_of}
    left = [rf"\dot{{{shown[int(n)]}}}" for n in traced.q]
    left += [
        rf"\ddot{{{rate_of[n]}}}" if n in rate_of else rf"\dot{{{shown[n]}}}"
        for n in (int(traced.u[i]) for i in lowered.independent)
    ]
    symbols = {sympy.Symbol(names[n]): symbol for n, symbol in shown.items()}
    # round long fractions such as 144952661367387/50000000000000, but not 9/2
    values = [
        value.replace(lambda x: x.is_Rational and x.q >= 1000, lambda number: sympy.Float(number, 6))
        for value in expressions(lowered).values()
    ]
    lines = [
        f"{rate} &= {sympy.latex(value, symbol_names=symbols)}"
        for rate, value in zip(left, values, strict=True)
    ]
    return " \\\\\n".join(line for line in lines if len(set(line.split(" &= "))) > 1)


def _symbol(name: str) -> str:
    """Return the LaTeX of a name: single Latin or Greek letters in italics, other words upright, and a
    trailing number as subscript.
    """
    import sympy

    letter = name.rstrip("0123456789").rstrip("_")
    number = name[len(letter) :].strip("_")
    written = sympy.latex(sympy.Symbol(letter))
    italic = len(letter) == 1 or (written.startswith("\\") and "_" not in letter)
    base = written if italic else r"\mathrm{" + letter.strip("_.").replace("_", r"\_") + "}"
    return f"{base}_{{{number}}}" if number else base
