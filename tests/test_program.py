"""The scalar program: graph, derivatives, normal forms, values, code."""

import itertools
import math
import subprocess
import threading

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.derivative import derivatives
from jourdain_jax.program.emit import run, sine_and_cosine
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph, Unsupported
from jourdain_jax.program.interpret import Nodes, as_nodes, interpret
from jourdain_jax.program.polynomial import NormalForms, TooLarge
from jourdain_jax.program.source import PYTHON, C, statements, sympy_expressions


@pytest.fixture
def graph():
    return Graph()


def _x(graph, *names):
    return [graph.input(name, True) for name in names]


def test_equal_expressions_are_one_node(graph):
    x, y = _x(graph, "x", "y")
    assert graph.mul(x, y) == graph.mul(y, x)
    assert graph.add(graph.mul(x, y), x) == graph.add(x, graph.mul(y, x))


def test_what_is_known_while_building_is_folded(graph):
    (x,) = _x(graph, "x")
    two = graph.const(2.0)
    assert graph.mul(graph.zero, x) == graph.zero
    assert graph.add(graph.zero, x) == x
    assert graph.mul(graph.one, x) == x
    assert graph.sub(x, x) == graph.zero
    assert graph.add(x, graph.neg(x)) == graph.zero
    assert graph.value[graph.call("sqrt", graph.mul(two, two))] == 2.0
    assert graph.call("sin", graph.neg(x)) == graph.neg(graph.call("sin", x))
    assert graph.call("cos", graph.neg(x)) == graph.call("cos", x)
    assert graph.sub(graph.sub(x, two), x) == graph.neg(two)
    root = graph.call("sqrt", x)
    assert graph.mul(root, root) == x


def test_only_operations_on_varying_quantities_count(graph):
    (x,) = _x(graph, "x")
    a = graph.input("a", False)
    y = graph.add(graph.mul(graph.mul(a, a), x), graph.call("sin", x))
    assert graph.operations([y]) == 3


FUNCTIONS = {
    "smooth": lambda x, y: jnp.stack(
        [
            jnp.sin(x) * jnp.exp(-y) + x / (1 + y * y),
            jnp.sqrt(1 + x * x) * jnp.tanh(y),
            jnp.arctan2(x, y) ** 3,
        ]
    ),
    "kinked": lambda x, y: jnp.stack(
        [jnp.abs(x) * y, jnp.maximum(x, y) - jnp.minimum(x, y), jnp.where(x > y, x * x, y)]
    ),
    "matrices": lambda x, y: (
        (jnp.array([[1.0, x], [y, 2.0]]) @ jnp.stack([x, y]))[::-1].at[0].add(y).at[1].set(x * y)
    ),
    "powers": lambda x, y: jnp.stack(
        [x**3, y**-2, jnp.prod(jnp.stack([x, y])), x**1.5, (-y) ** x, x**2.0, jnp.cbrt(y), jnp.exp2(y)]
    ),
    "inverses": lambda x, y: jnp.stack(
        [jnp.asinh(y), jnp.acosh(1.0 + x), jnp.atanh(0.4 * y), jnp.asin(0.4 * x), jnp.acos(0.4 * x)]
    ),
    "near one": lambda x, y: jnp.stack([jnp.log1p(x), jnp.expm1(y), jax.lax.logistic(x * y)]),
    "steps": lambda x, y: jnp.stack(
        [
            jnp.floor(3 * x) * y,
            jnp.ceil(3 * x) * y,
            jnp.round(3 * y) * x,
            jnp.mod(3 * y, x),
            jnp.fmod(3 * x, y),
        ]
    ),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_traced_function_and_its_derivative_are_those_of_jax(graph, name):
    f = FUNCTIONS[name]
    x, y = _x(graph, "x", "y")
    (found,) = interpret(graph, jax.make_jaxpr(f)(1.0, 1.0), [Nodes(x), Nodes(y)])
    nodes = np.ravel(as_nodes(graph, found)).tolist()
    dots = derivatives(graph, nodes, {x: graph.const(0.3), y: graph.const(-1.7)})
    points = np.random.default_rng(0).uniform(0.2, 2.0, (2, 20)) * [[1], [-1]]
    probes = Probes(graph, {"x": points[0], "y": points[1]})
    value, dot = jax.vmap(lambda x, y: jax.jvp(f, (x, y), (0.3, -1.7)))(*points)
    assert_allclose(probes(nodes).T, value, rtol=1e-13, atol=1e-13)
    assert_allclose(probes(dots).T, dot, rtol=1e-12, atol=1e-12)


def test_an_operation_without_scalar_form_is_named(graph):
    (x,) = _x(graph, "x")
    with pytest.raises(Unsupported, match="while"):
        interpret(
            graph,
            jax.make_jaxpr(lambda x: jax.lax.while_loop(lambda v: v < 10.0, lambda v: 2 * v, x))(1.0),
            [Nodes(x)],
        )
    with pytest.raises(Unsupported, match="depends on the state"):
        interpret(graph, jax.make_jaxpr(lambda x: jnp.arange(3.0)[jnp.int32(x)])(1.0), [Nodes(x)])


# Normal forms.


def test_a_root_of_a_square_is_a_magnitude_and_a_known_sign_a_guard(graph):
    (x,) = _x(graph, "x")
    s, c = graph.call("sin", x), graph.call("cos", x)
    root = graph.call("sqrt", graph.sub(graph.one, graph.mul(s, s)))
    assert NormalForms(graph, 100).simplified(root) == graph.call("abs", c)
    probes = Probes(graph, {"x": np.linspace(-1.0, 1.0, 20)})
    forms = NormalForms(graph, 100, sign=probes.sign)
    assert forms.simplified(root) == c
    assert forms.guards == {c}


def test_a_form_does_not_depend_on_what_was_simplified_before(graph):
    x, y = _x(graph, "x", "y")
    generator, nodes, forms = np.random.default_rng(4), [x, y, graph.one], NormalForms(graph, 400)
    for op in ("sin", "sqrt", "cos", "abs", "sin") * 3:
        f, g, h = (nodes[i] for i in generator.integers(len(nodes), size=3))
        nodes += [
            graph.call(op, graph.add(f, graph.mul(g, h))),
            graph.div(graph.mul(f, f), graph.add(g, graph.mul(h, h))),
        ]
        product = graph.mul(graph.mul(nodes[-2], nodes[-1]), graph.mul(nodes[-2], f))
        expected = NormalForms(graph, 400).simplified(product)
        assert forms.simplified(product) == expected


def test_an_expansion_that_grows_is_left_alone(graph):
    names = _x(graph, *"abcdefgh")
    product = graph.one
    for first, second in itertools.pairwise(names):
        product = graph.mul(product, graph.add(first, graph.mul(second, second)))
    forms = NormalForms(graph, 20)
    with pytest.raises(TooLarge):
        forms.expanded(product)
    assert forms.simplified(product) == product


# Values and code.


def test_sine_and_cosine_are_right_to_the_last_digits():
    x = np.concatenate(
        [
            np.random.default_rng(0).uniform(-1e3, 1e3, 400),
            np.arange(-20, 21) * (np.pi / 4),
            [0.0, 1e-300, 1e-9, 1e5],
        ]
    )
    s, c = jax.jit(sine_and_cosine)(x)
    exact = np.array([[float(mpmath.sin(mpmath.mpf(v))), float(mpmath.cos(mpmath.mpf(v)))] for v in x])
    assert np.max(np.abs(np.stack([s, c], 1) - exact)) < 2.3e-16
    assert np.isnan(sine_and_cosine(jnp.inf)[0])


def _every_function(graph):
    x, y, a = *_x(graph, "x", "y"), graph.input("a", False)
    own = {"neg", "acosh", "sign", "not", "is_finite", "select"}  # no functions, or elsewhere
    of_one = [name for name, f in TABLE.items() if getattr(f.value, "nin", 1) == 1 and name not in own]
    return {"x": x, "y": y, "a": a}, [
        *(graph.call(name, x) for name in of_one),
        graph.call("acosh", a),
        *(graph.call(name, graph.neg(graph.mul(a, a)), y) for name in ("rem", "atan2", "max", "min")),
        graph.call("pow", a, y),
        graph.call("select", graph.call("gt", x, y), graph.div(graph.neg(x), a), y),
    ]


VALUES = {"x": 0.7, "y": -1.3, "a": 2.5}


def test_jax_code_python_c_and_sympy_say_the_same(graph, tmp_path):
    import sympy

    names, outputs = _every_function(graph)
    expected = Probes(graph, {k: np.array([v]) for k, v in VALUES.items()})(outputs)[:, 0]
    assert_allclose(
        run(graph, outputs, {n: jnp.asarray(VALUES[k]) for k, n in names.items()}), expected, rtol=1e-15
    )
    lines, last = statements(graph, outputs, {n: k for k, n in names.items()}, PYTHON)
    scope = {"math": math}
    exec("def f(x, y, a):\n" + "\n".join([*lines, f"    return {', '.join(last)}"]), scope)
    assert_allclose(scope["f"](**VALUES), expected, rtol=1e-15)
    symbols = sympy_expressions(graph, outputs, {n: k for k, n in names.items()})
    symbols = [
        e.replace(
            lambda f: str(getattr(f, "func", "")) == "round",
            lambda f: sympy.Integer(round(f.args[0].subs(VALUES))),
        )
        for e in symbols
    ]
    assert_allclose([float(e.subs(VALUES)) for e in symbols], expected, rtol=1e-14)
    lines, last = statements(graph, outputs, {n: k for k, n in names.items()}, C)
    body = "\n".join([*lines, *(f'    printf("%.17g\\n", {e});' for e in last)])
    source = (
        "#include <math.h>\n#include <stdio.h>\nint main(void) { const double x = 0.7, y = -1.3, a ="
        f" 2.5;\n{body}\n return 0; }}\n"
    )
    (tmp_path / "f.c").write_text(source)
    try:
        subprocess.run(
            ["cc", str(tmp_path / "f.c"), "-o", str(tmp_path / "f"), "-lm"], check=True, capture_output=True
        )
    except FileNotFoundError:
        pytest.skip("no C compiler")
    out = subprocess.run([str(tmp_path / "f")], check=True, capture_output=True, text=True).stdout
    assert_allclose([float(v) for v in out.split()], expected, rtol=1e-14)


def test_a_computation_of_too_many_scalars_is_refused_before_it_is_built(monkeypatch):
    monkeypatch.setattr("jourdain_jax.program.graph.MOST_NODES", 50)
    graph = Graph()
    with pytest.raises(Unsupported, match="more than 50 scalars"):
        graph.total(graph.input(f"x{i}", True) for i in range(50))


# The table of operations: a new entry is tested here.


@pytest.mark.parametrize("name", TABLE)
def test_an_operation_has_one_value_one_derivative_and_a_bound_of_its_round_off(graph, name):
    operation = TABLE[name]
    arity = {"select": 3, "logistic": 1}.get(name) or operation.value.nin
    points = np.random.default_rng(3).uniform(0.2, 0.9, (arity, 20)) + (1.0 if name == "acosh" else 0.0)
    variables = _x(graph, *"xyz"[:arity])
    node = graph.call(name, *variables)
    flags = [
        operation.kind == "choice" and name != "is_finite" and (name != "select" or k == 0)
        for k in range(arity)
    ]
    given = [x > 0.5 if flag else x for x, flag in zip(points, flags, strict=True)]

    def in_jax(*moving):
        return (
            operation.in_jax(
                *(fixed if flag else x for fixed, x, flag in zip(given, moving, flags, strict=True))
            )
            * 1.0
        )

    value, rate = jax.jvp(in_jax, tuple(points), tuple(0.3 * points))
    probes = Probes(graph, dict(zip("xyz", given, strict=False)))
    assert_allclose(probes([node])[0], value, rtol=1e-14)
    rates = (
        graph.zero if flag else graph.mul(graph.const(0.3), x)
        for x, flag in zip(variables, flags, strict=True)
    )
    direction = dict(zip(variables, rates, strict=True))
    assert_allclose(probes(derivatives(graph, [node], direction))[0], rate, rtol=1e-12, atol=1e-14)
    if operation.bounded:
        single = [np.concatenate([x.astype(np.float32).astype(float), 6e-8 * np.abs(x)]) for x in points]
        near, bound = np.split(operation.bounded(*single), 2)
        assert np.all(np.abs(near - operation.value(*points)) <= bound)
        assert np.all(bound <= 1e-4 * (1.0 + np.abs(near)))


def test_two_threads_that_want_a_new_node_at_once_get_the_same():
    both_looked, graph, found = threading.Barrier(2, timeout=10), Graph(), []

    class Known(dict):
        def get(self, key):
            node = super().get(key)
            both_looked.wait()
            return node

    x = graph.input("x", True)
    graph._known = Known(graph._known)
    threads = [threading.Thread(target=lambda: found.append(graph.call("sinh", x))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [len(graph.op) - 1] * 2
