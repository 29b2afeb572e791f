"""Taylor series by machine code: their coefficients against mpmath, motions against closed forms and Dopri8,
and when they are refused.
"""

import diffrax
import jax
import jax.numpy as jnp
import machine_code
import mpmath
import numpy as np
import pytest
from in_mpmath import in_mpmath
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import OnLine

import jourdain_jax as jj
from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.integrate.loop.lanes import MachineWriter
from jourdain_jax.integrate.loop.taylor import Series
from jourdain_jax.kernels import ffi, host
from jourdain_jax.kernels.scalar_program import written
from jourdain_jax.program.graph import Graph

pytestmark = machine_code.needed

ORDER = 9
TWO = ["add", "sub", "mul", "mul", "div"]
UNARY = [
    name
    for name, f in TABLE.items()
    if f.kind in ("analytic", "flat") and name not in ("add", "sub", "mul", "div", "pow", "atan2")
]


def coefficients(graph, s, outputs, at, known=None):
    """Taylor coefficients, (orders, outputs), of functions of s about a point, as machine code has them;
    `known`: values of other inputs.
    """
    assert not ffi.reason_against()
    w = MachineWriter(host.lanes(), host.fuses())

    def block(arguments, found):
        # z' = f(s), s' = 1: coefficients of z are those of f over their order plus one
        moved = [s, *(graph.input(f"z{i}", True) for i in range(len(outputs)))]
        given = {clock: w.number(0.0)} | {node: w.number(value) for node, value in (known or {}).items()}
        series = Series(graph, given, moved, [graph.one, *outputs], ORDER, clock).state[1:]
        nodes = [graph.mul(graph.const(k), x[k]) for k in range(1, ORDER + 1) for x in series]
        start = dict.fromkeys(moved, w.number(0.0)) | {s: w.load(arguments[0].data)}
        for i, x in enumerate(written(w, graph, nodes, given | start)):
            w.store(x, found[0].data, i)

    clock = graph.input("clock", True)
    ffi.write_handler(w, 1, 1, block)
    shape = jax.ShapeDtypeStruct((ORDER, len(outputs), w.lanes), jnp.float64)
    points = jnp.broadcast_to(jnp.asarray(at), (w.lanes,))
    return np.asarray(jax.ffi.ffi_call(ffi.registered(w.text), shape)(points))[..., -1]


def expected(f, at):
    """Those by mpmath."""
    with mpmath.workdps(80):
        return np.array([float(c) for c in mpmath.taylor(f, mpmath.mpf(at), ORDER - 1)])


def test_recurrences_of_functions_give_their_taylor_series():
    graph = Graph()
    s = graph.input("s", True)
    base = {op: 1.3 if op == "acosh" else 0.4 for op in UNARY}
    inner = graph.mul(graph.const(0.3), graph.mul(s, s))
    sine, growth, power = (
        (graph.call("sin", s), mpmath.sin),
        (graph.call("exp", s), mpmath.exp),
        graph.const(2.7),
    )
    cases = [
        (op, (graph.add(graph.const(at), inner), lambda s, at=at: mpmath.mpf(at) + mpmath.mpf(0.3) * s * s))
        for op, at in base.items()
    ]
    cases += [(op, *pair) for op in {*TWO, "atan2"} for pair in ((sine, growth), (growth, sine))]
    cases.append(("pow", sine, (power, lambda s: mpmath.mpf(2.7))))
    found = coefficients(graph, s, [graph.call(op, *(n for n, _ in of)) for op, *of in cases], 0.7)
    for (op, *of), series in zip(cases, found.T, strict=True):
        true = expected(lambda s, op=op, of=of: in_mpmath(op)(*(f(s) for _, f in of)), 0.7)
        close = 1e-14 * np.max(np.abs(true)) if len(of) == 1 else 1e-13
        assert_allclose(series, true, rtol=1e-13, atol=close, err_msg=op)


# Motions. ---------------------------------------------------------------------------------------------------

DISC, SLEIGH = jj.models.TiltingDisc(), jj.models.ChaplyginSleigh()


class Power(OnLine):
    """A mass under a force whose exponent varies."""

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=-((2.0 + motion.q.x**2) ** motion.q.x))


def test_errors_of_a_sleigh_fall_with_the_tolerance_and_steps_with_the_order():
    start = jj.start(SLEIGH, **SLEIGH.example)

    @jax.jit
    def run(tolerance, start):
        motion = jj.simulate(SLEIGH, start, ts=[12.0], rtol=tolerance, atol=tolerance, solver=jj.Taylor(10))
        return jnp.concatenate([motion.q_end, motion.u_end]), motion.accepted

    best = jj.simulate(SLEIGH, start, ts=[12.0], rtol=3e-14, atol=3e-14, solver=diffrax.Dopri8())
    true, steps = np.concatenate([best.q_end, best.u_end]), []
    for tolerance in 10.0 ** -np.arange(6, 14):
        found, accepted = run(tolerance, start)
        assert np.max(np.abs(found - true)) < 10 * tolerance + 1e-13
        steps.append(int(accepted))
    # h ~ tolerance^(1/p)
    assert_allclose(steps[-1] / steps[0], 10 ** (7 / 10), rtol=0.15)


@pytest.mark.parametrize("span", [2.0, -2.0])
def test_motions_with_projection_and_work_are_those_of_dopri8(span):
    scene = jj.models.DoublePendulumRods()
    options = {"ts": np.linspace(0.0, span, 11), "rtol": 1e-11, "atol": 1e-11}
    ours, theirs = (
        jj.simulate(scene, solver=solver, **options) for solver in (jj.Taylor(), diffrax.Dopri8())
    )
    assert ours.solver == "Taylor"
    for a, b in ((ours.q, theirs.q), (ours.u, theirs.u), (ours.q_end, theirs.q_end)):
        assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    if ours.work is not None:
        assert_allclose(ours.work, theirs.work, atol=1e-9)
    # states between the ends of steps are on the rows, too
    moved = [jj.consistent(scene, 0.0, q, u).moved_q for q, u in zip(ours.q, ours.u, strict=True)]
    assert np.max(moved) < 1e-12


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda: jj.simulate(DISC, t1=1.0, solver=jj.Taylor(), backend="xla"),
            "jj.Taylor\\(\\) cannot integrate `TiltingDisc`: another backend",
        ),
        (
            lambda: jj.simulate(jj.models.BallOnTurntable(), t1=1.0, solver=jj.Taylor(30)),
            "products, more than",
        ),
        (lambda: jj.simulate(jj.models.SpringAndRod(), t1=1.0, solver=jj.Taylor()), "has no Taylor series"),
        (lambda: jj.simulate(Power(), {"x": 0.3}, t1=1.0, solver=jj.Taylor()), "an exponent varies"),
        (lambda: jj.Taylor(2), "`order` is 2, expected a whole number from 4 to 30"),
    ],
)
def test_series_that_do_not_serve_are_refused_with_the_reason(call, said):
    refused(said, call)
