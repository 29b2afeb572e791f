"""A graph as text: readable Python, C, or SymPy expressions. What is used more than once gets a name of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jourdain_jax.program.graph import Graph

LONGEST = 110  # characters of an expression before it is given a name


@dataclass(frozen=True)
class Language:
    """How expressions and statements are written."""

    functions: Mapping[str, str]
    assignment: str
    select: str


_LIBRARY = ["sin", "cos", "tan", "sqrt", "exp", "log", "tanh", "sinh", "cosh", "atan2", "asin", "acos", "atan", "asinh", "acosh", "atanh"]
_LIBRARY += ["exp2", "expm1", "log1p", "cbrt", "floor", "ceil", "pow"]

PYTHON = Language(
    {n: f"math.{n}" for n in _LIBRARY}
    | {"rem": "math.fmod", "round": "round", "logistic": "1.0 / (1.0 + math.exp(-({0})))"}
    | {"abs": "abs", "max": "max", "min": "min", "sign": "sign", "is_finite": "math.isfinite", "and": "and", "or": "or", "not": "not "},
    "    {name} = {value}",
    "({b} if {c} else {a})",
)
C = Language(
    {n: n for n in _LIBRARY}
    | {"rem": "fmod", "round": "rint", "logistic": "1.0 / (1.0 + exp(-({0})))"}
    | {"abs": "fabs", "max": "fmax", "min": "fmin", "sign": "sign", "is_finite": "isfinite", "and": "&&", "or": "||", "not": "!"},
    "    const double {name} = {value};",
    "({c} ? {b} : {a})",
)
_COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
_INFIX = {"add": ("+", 1), "sub": ("-", 1), "mul": ("*", 2), "div": ("/", 2)} | {op: (sign, 0) for op, sign in _COMPARED.items()}


def statements(graph: Graph, outputs: Sequence[int], names: Mapping[int, str], language: Language, prefix: str = "s") -> tuple[list[str], list[str]]:
    """Lines that name what is used more than once, and the expressions of the outputs. `names`: of inputs and of nodes known already."""
    nodes = _needed(graph, outputs, names)
    uses: dict[int, int] = {}
    for node in nodes:
        for a in graph.args[node]:
            uses[a] = uses.get(a, 0) + 1
    for node in outputs:
        uses[node] = uses.get(node, 0) + 1
    written: dict[int, tuple[str, int]] = {n: (name, 9) for n, name in names.items()}  # text and how tightly it binds
    lines: list[str] = []
    for node in nodes:
        text, binds = _expression(graph, node, written, language)
        if graph.args[node] and (uses[node] > 1 or len(text) > LONGEST) and binds < 9:
            name = f"{prefix}{len(lines)}"
            lines.append(language.assignment.format(name=name, value=text))
            text, binds = name, 9
        written[node] = text, binds
    return lines, [written[n][0] for n in outputs]


def _needed(graph: Graph, outputs: Sequence[int], names: Mapping[int, str] | dict) -> list[int]:
    """What is to be written, in order; a ValueError where a call of JAX is among it."""
    nodes = graph.needed(outputs, names)
    reasons = dict.fromkeys(graph.value[n].reason for n in nodes if graph.op[n] == "kept")
    if reasons:
        raise ValueError(
            f"what is kept as a call of JAX ({'; '.join(reasons)}) cannot be written as text; "
            "print the scene without the load it belongs to, or give that load a scalar form"
        )
    return nodes


def _expression(graph: Graph, node: int, written, language: Language) -> tuple[str, int]:
    op, args = graph.op[node], graph.args[node]
    if op == "const":
        value = graph.value[node]
        text = repr(int(value)) + ".0" if value == int(value) and abs(value) < 1e15 else repr(value)
        return text, 9 if value >= 0 else 1
    if op == "input":
        return str(graph.value[node]), 9
    if op == "neg":
        return "-" + _inside(written[args[0]], 3), 1
    if op in _INFIX:
        sign, level = _INFIX[op]
        left, right = written[args[0]], written[args[1]]
        return f"{_inside(left, level)} {sign} {_inside(right, level + (op != 'add'))}", level
    if op in ("and", "or", "not"):
        *first, last = (f"({written[a][0]})" for a in args)
        return f"({' '.join(first)} {language.functions[op]} {last})" if first else f"({language.functions[op]}{last})", 9
    if op == "select":
        c, a, b = (written[x][0] for x in args)
        return language.select.format(c=c, a=a, b=b), 9
    function, operands = language.functions.get(op, op), ", ".join(written[a][0] for a in args)
    return (f"({function.format(operands)})" if "{" in function else f"{function}({operands})"), 9


def _inside(part: tuple[str, int], level: int) -> str:
    text, binds = part
    return text if binds >= level else f"({text})"


def sympy_expressions(graph: Graph, outputs: Sequence[int], names: Mapping[int, str]) -> list:
    """The outputs as SymPy expressions; needs SymPy."""
    import sympy

    functions: dict = {"abs": sympy.Abs, "max": sympy.Max, "min": sympy.Min, "select": lambda c, a, b: sympy.Piecewise((b, c), (a, True))}
    functions |= {"add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "div": lambda a, b: a / b, "neg": lambda a: -a}
    functions |= {"lt": sympy.Lt, "le": sympy.Le, "gt": sympy.Gt, "ge": sympy.Ge, "eq": sympy.Eq, "ne": sympy.Ne}
    functions |= {"expm1": lambda a: sympy.exp(a) - 1, "log1p": lambda a: sympy.log(a + 1), "exp2": lambda a: 2**a, "pow": sympy.Pow}
    functions |= {"logistic": lambda a: 1 / (1 + sympy.exp(-a)), "ceil": sympy.ceiling, "round": sympy.Function("round")}
    functions["rem"] = lambda a, b: a - b * sympy.sign(a / b) * sympy.floor(sympy.Abs(a / b))
    functions |= {"and": sympy.And, "or": sympy.Or, "not": sympy.Not}
    values: dict = {n: sympy.Symbol(name) for n, name in names.items()}
    for node in _needed(graph, outputs, values):
        op = graph.op[node]
        if op == "const":
            values[node] = sympy.nsimplify(graph.value[node], rational=True) if abs(graph.value[node]) < 1e6 else sympy.Float(graph.value[node])
        else:
            values[node] = (functions.get(op) or getattr(sympy, op))(*(values[a] for a in graph.args[node]))
    return [values[n] for n in outputs]
