"""Lower a scene: build several candidate programs, compare them with each other and with dense matrices, and
keep the one with the fewest operations. If lowering fails, the reason is reported.
"""

import time
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import islice

import jax
import numpy as np

from jourdain_jax.calculus.progress import announced
from jourdain_jax.calculus.reals import Indices, is_traced
from jourdain_jax.equations.rows import names_of_events, stops
from jourdain_jax.kernels import ffi
from jourdain_jax.lowering.appell import AppellOnGraph, Equations, Strategy
from jourdain_jax.lowering.comparison import (
    agree,
    check_against_dense,
    comparison_probes,
    full_turns,
    on_velocity_rows,
    rates_of,
    values_at,
)
from jourdain_jax.lowering.ignorable import ignorable
from jourdain_jax.lowering.lowered_equations import Lowered, NotLowered, Stage
from jourdain_jax.lowering.multipliers import KeptRows
from jourdain_jax.lowering.relations import relations, sided
from jourdain_jax.program.evaluate import Probes, part_of
from jourdain_jax.program.graph import Graph, NodeList, Unsupported
from jourdain_jax.program.identity_test import IdentityProbes, equal
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.coordinates import parameters_of
from jourdain_jax.scene.identity import (
    once_per_class,
    once_per_values,
    with_reference_parameters,
    with_usual_parameters,
)
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import Structure, structure_of, structure_whatever_its_faults
from jourdain_jax.structure.trace import Variables, traced_scene

# Maximum numbers of operations of a program before simplification, with XLA and with machine code. Larger
# scenes use dense matrices. With XLA, a program of 20,000 operations takes about a minute longer to compile
# than dense matrices (24 joint angles, 20,762 operations: 71 and 7.5 s), though an evaluation takes 0.15 of
# their time (0.22 in a batch). Smaller programs are always faster (bench/README.md). With machine code,
# larger programs are faster, too: a quadruped of 20,550 operations takes 11 s of processor time to the first
# motion (dense matrices 50 s), then 0.02 s (5.5 s). Machine code is limited to 60,000 operations, integration
# steps included.
MOST_OPERATIONS, MOST_IN_MACHINE_CODE = 20_000, 50_000  # tuning
MOST_TERMS = 200  # tuning: maximum number of terms of one normal form

# the part of the structure that decides which program is built
_DECISIVE = "rank", "redundant_rows", "may_set_in", "affine", "homogeneous", "driven", "varying_inertia"
_DECISIVE += "potentials_of_inputs", "independent"


def lowered(scene: Scene, every_speed: bool | None = None) -> Lowered | NotLowered:
    """Return the lowered equations of the scene's class, or the reason why there are none. They are built
    once per class, shapes and `_DECISIVE` part of the structure, with the class's default parameters; where
    these have no admissible state, once per parameter values.

    `every_speed`: whether all speeds stay in the state, with multipliers for the constraints (default: only
    if no choice of independent speeds is valid everywhere).
    """
    structure = structure_of(scene)
    every_speed = not structure.has_minimal_state if every_speed is None else every_speed
    every_speed = every_speed or not structure.row_names
    massless = bool(every_speed and structure.row_names) and may_be_massless(scene, structure)
    kept = {name: getattr(structure, name) for name in _DECISIVE}
    kept["worst_pivot"] = float(structure.well_conditioned)
    if every_speed and not structure.well_conditioned:
        kept["independent"] = ()
    case = every_speed, massless, tuple(kept.items())
    return _lowered(scene, *case) or _lowered_at(scene, *case)


def lower(scene: Scene | BuiltFor, every_speed: bool | None = None) -> Lowered:
    """Return the lowered equations of the class of `scene`: the scalar program that `simulate` and `rollout`
    integrate. Raises `NotLowered`, with the reason, if there is none.

        print(jj.lower(disc))                     operations after each step, omitted parts
        print(jj.lower(disc).python_source())     also c_source(), expressions() and latex() (SymPy)

    `every_speed`: True keeps all speeds in the state, with multipliers for the constraints; False eliminates
    dependent speeds. By default they are eliminated if some choice of independent speeds is valid everywhere
    in the scene's domain.
    """
    scene = as_scene(scene)
    found = lowered(scene, every_speed)
    if isinstance(found, NotLowered):
        raise NotLowered(f"`{type(scene).__name__}` cannot be lowered: {found}") from None
    return found


@once_per_class
def _lowered(scene: Scene, *case) -> Lowered | NotLowered | None:
    """Return the program at the class's default parameters; None if they have no admissible state."""
    usual, stated = with_usual_parameters(scene)
    try:
        found = _lowered_at(usual, *case)
    except ValueError:
        return None
    return found if stated or isinstance(found, Lowered) else None


@once_per_values
def _lowered_at(scene: Scene, every_speed: bool, massless: bool, kept: tuple) -> Lowered | NotLowered:
    """Return the program at these parameters, with the part `kept` of the structure."""
    begin = time.perf_counter()
    structure = replace(structure_whatever_its_faults(scene), **dict(kept))
    try:
        # probes with undefined values are ignored
        with np.errstate(all="ignore"), announced(f"deriving the equations of `{type(scene).__name__}`"):
            found = _built(scene, structure, every_speed, massless)
    except NotLowered as reason:
        return NotLowered(str(reason))  # without its traceback
    return replace(found, seconds=time.perf_counter() - begin)


def _built(scene: Scene, structure: Structure, every_speed: bool, massless: bool) -> Lowered:
    if not (structure.affine or every_speed):
        raise NotLowered("its constraints are nonlinear in the speeds")
    if structure.may_set_in:
        named = ", ".join(f"`{name}`" for name in structure.may_set_in)
        raise NotLowered(
            f"constraints {named} are redundant at all probed states, but not provably everywhere"
        )
    if every_speed and structure.dependent_rows and not structure.well_conditioned:
        raise NotLowered("its constraints are redundant, but no constraint can be omitted everywhere")
    try:
        traced = traced_scene(scene, structure.potentials_of_inputs)
        if traced.effects:
            raise Unsupported(traced.effects)
        loops = (
            traced.graph.value[call].loop
            for call in traced.graph.calls(n for part in traced.motion for n in part.ravel().tolist())
        )
        if loop := next(filter(None, loops), None):
            # measured: a ball on a hill, whose contact point is found by Newton's method, takes four times as
            # long as with dense matrices
            raise Unsupported(f"the operation `{loop}`")
        probes = comparison_probes(scene, structure, traced)
        # at states that violate the velocity constraints, redundant constraints contradict each other
        if every_speed and len(structure.row_names) > structure.rank:
            probes = on_velocity_rows(probes, traced)
        far = full_turns(probes, traced)
        kept = None
        if every_speed and structure.row_names:
            kept = KeptRows(traced.graph, structure, massless, probes, far)
        reference = scene.coordinates.reference()
        return _best(scene, structure, AppellOnGraph(traced, structure, kept, probes, far, reference))
    except Unsupported as reason:
        raise NotLowered(f"{reason} has no scalar form") from None
    except ZeroDivisionError:
        raise NotLowered("every order of elimination meets a zero pivot") from None


def _best(scene: Scene, structure: Structure, builder: AppellOnGraph) -> Lowered:
    graph, probes = builder.graph, builder.probes
    first = Strategy(explicit=bool(builder.multiplied))
    best, way = builder.build(first), first
    fewest = graph.operations(rates_of(best))
    most = MOST_OPERATIONS if ffi.reason_against() else MOST_IN_MACHINE_CODE
    if fewest > most:
        raise NotLowered(f"its scalar program has {fewest} operations, more than {most}")
    expected = values_at(best, probes)
    check_against_dense(scene, structure, builder, best, expected)
    # try further strategies only below 1000 operations
    held, small = ignorable(scene, builder, best, expected), 1000
    stages = [
        Stage("scalar program: structural zeros and ones removed, common subexpressions shared", fewest)
    ]
    plainly_held = fewest
    # if there are more than 4000 operations, fixing ignorable coordinates never yields a small program
    if held and fewest < 4000:
        plainly_held = graph.operations(rates_of(builder.build(replace(first, held=held))))
        stages.append(Stage("ignorable coordinates fixed in the accelerations", plainly_held))
    for strategy in _strategies(builder, held, plainly_held < small, fewest):
        candidate = builder.build(strategy)
        count = graph.operations(graph.with_quotients(rates_of(candidate)))
        if count < fewest and agree(values_at(candidate, probes), expected):
            best, fewest, way = candidate, count, strategy
    stages.append(Stage("normal forms modulo sin^2 + cos^2 = 1, common factors extracted", fewest))
    put_q, put_u = builder.projection(MOST_TERMS if fewest < small else 0, held)
    names = "qdot", "ydot", "z", "pivots", "directions", "squares", "guards", "power", "events", "resets"
    groups = {name: getattr(best, name) for name in (*names, "energies")}
    of_rates = [] if scene.speeds is None else _divisors(graph, builder.traced.at.qdot.tolist())
    pivots = _relative(graph, probes, [*of_rates, *best.pivots])
    groups |= {"at_start": builder.traced.at.start.tolist(), "power": [best.power], "pivots": pivots}
    groups |= {"projected_q": put_q, "projected_u": put_u}
    every = [n for group in groups.values() for n in group]
    outputs = graph.with_quotients(_with_equal_calls_once(builder.identity_probes, every))
    rest = iter(outputs)
    nodes = {name: tuple(islice(rest, len(group))) for name, group in groups.items()}
    (power,) = nodes.pop("power")
    rates = [*nodes["qdot"], *nodes["ydot"]]
    _check_resets(scene, builder, best)
    of_contacts = builder.traced.inputs.tolist()[len(scene.inputs) - len(scene.switching.contacts) :]
    nodes["relations"], nodes["event_relations"] = watched = relations(
        graph, rates, nodes["events"], probes, of_contacts
    )
    every = [n for part in watched for n in part]
    nodes["sided"] = sided(graph, every, [*rates, *nodes["events"]], probes)
    nodes["fixed"], own = graph.fixed([*outputs, *every]), builder.traced
    given = [own.t, *own.q.tolist(), *own.u.tolist(), *own.inputs.tolist()]
    given += [n for x in own.parameters for n in x.ravel().tolist()]
    # on a new graph, without the nodes of other candidates
    alone, places = part_of(graph, [*given, power, *(n for part in nodes.values() for n in part)])
    place = places.tolist()
    names = scene.coordinate_names.entries
    leaves = tuple(jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(scene)[0])
    units = {f".{name}": metadata["unit"] for name, _, metadata in parameters_of(scene)}
    return Lowered(
        traced=Variables(
            alone,
            place[own.t],
            places[own.q],
            places[own.u],
            places[own.inputs],
            [np.asarray(places[x]) for x in own.parameters],
        ),
        scene_name=type(scene).__name__,
        parameters=leaves,
        units=tuple(units.get(name, "") for name in leaves),
        conventions=scene.conventions,
        coordinates=names,
        speeds=scene.speed_names.entries,
        inputs=scene.inputs.entries,
        independent=tuple(builder.independent),
        dependent=tuple(builder.dependent),
        divisors=len(of_rates),
        power=place[power],
        by_partition=builder.kept is not None and builder.kept.by_partition,
        stops=stops(scene),
        left_out=structure.redundant_rows,
        held=tuple(names[i] for i in held),
        stages=tuple(stages),
        way=builder.kept.description if builder.kept else way.description,
        seconds=0.0,  # set later
        sides=(),
        **{name: tuple(place[n] for n in part) for name, part in nodes.items()},
    )


def _check_resets(scene: Scene, builder: AppellOnGraph, found: Equations) -> None:
    """Raise ValueError if an event sets dependent speeds that violate the constraints."""
    graph, traced, first = builder.graph, builder.traced, len(builder.traced.q)
    for name, row in zip(names_of_events(scene), traced.at.resets.tolist(), strict=False):
        if not row or not builder.dependent:
            continue
        kept = [*traced.q.tolist(), *(int(traced.u[k]) for k in builder.independent)]
        after = dict(zip(kept, [*row[:first], *(row[first + k] for k in builder.independent)], strict=True))
        true_z = {int(traced.u[k]): n for k, n in zip(builder.dependent, found.z, strict=True)}
        stated = builder.probes(graph.substituted([row[first + k] for k in builder.dependent], true_z))
        by_rows = builder.probes(graph.substituted(graph.substituted(found.z, after), true_z))
        if np.any(np.abs(stated - by_rows) > 1e-6 * (1 + np.abs(by_rows))):
            speeds = scene.speed_names.entries
            both = builder.independent, builder.dependent
            free, tied = (", ".join(f"`{speeds[k]}`" for k in which) for which in both)
            raise ValueError(
                f"event `{name}` of `{type(scene).__name__}` sets speeds that violate the velocity "
                f"constraints, which determine {tied} from {free}; set all of them consistently, or "
                "declare the independent ones as `privileged`"
            )


def _divisors(graph: Graph, qdot: NodeList) -> NodeList:
    """Return the divisors in the coordinate rates, such as sin q in w/sin q. Divisors that `where` keeps away
    from zero are omitted.
    """
    nodes = [n for n in graph.reachable(qdot) if graph.varies[n]]
    found = [graph.args[n][1] for n in nodes if graph.op[n] == "div"]
    found += [graph.call("cos", *graph.args[n]) for n in nodes if graph.op[n] == "tan"]
    return [n for n in dict.fromkeys(found) if graph.varies[n] and graph.op[n] != "select"]


def _strategies(builder: AppellOnGraph, held: Indices, small: bool, plainly: int) -> Iterator[Strategy]:
    """Yield the strategies worth trying. `plainly`: number of operations without normal forms.

    Of twelve strategies, no other gave fewer operations for any model, with eliminated speeds or all speeds.
    """
    if builder.multiplied:
        yield Strategy(True, MOST_TERMS, MOST_TERMS if small else 0, held=held)
    elif small:
        yield Strategy(False, MOST_TERMS, MOST_TERMS, held=held)
        yield Strategy(False, MOST_TERMS, MOST_TERMS, by_determinants=True, held=held)
    else:
        yield Strategy(False, MOST_TERMS, held=held)
        # for larger programs, the explicit strategy is not tried
        if plainly > 5000:
            return
        if builder.graph.operations(rates_of(builder.build(Strategy(True)))) <= 1.35 * plainly:
            yield Strategy(True, MOST_TERMS, held=held)


def _relative(graph: Graph, probes: Probes, pivots: NodeList) -> NodeList:
    """Return the pivots divided by their values at a probe with the same parameters. Pivots that depend only
    on parameters have no other value; for these, see `_uncancelled`.
    """
    return [
        graph.div(n, probes.in_the_middle(n)) if graph.varies[n] else _uncancelled(graph, n) for n in pivots
    ]


def _uncancelled(graph: Graph, pivot: int) -> int:
    """Return `1.01 p / (|p| + S / 100)` for a pivot p of parameters, with the sum S of the magnitudes of its
    terms: the sign of p, unless the terms cancel to less than some hundredths.

    The error of a motion grows as `(S / p)^2`. With double precision it reaches 1e-9 where `p / S` is 1e-5,
    at which the result falls below the limit for pivots, 1e-3.
    """
    sizes: dict[int, int] = {}
    for n in sorted(graph.reachable([pivot])):  # arguments come first
        op, args = graph.operation(n)
        if op in ("add", "sub"):
            sizes[n] = graph.add(sizes[args[0]], sizes[args[1]])
        elif op in ("mul", "neg"):
            sizes[n] = graph.mul(*(sizes[k] for k in args)) if op == "mul" else sizes[args[0]]
        elif op == "div":
            sizes[n] = graph.div(sizes[args[0]], graph.call("abs", args[1]))
        else:
            sizes[n] = graph.call("abs", n)
    if not any(graph.op[n] in ("add", "sub") for n in sizes):
        return graph.call("sign", pivot)
    share = graph.mul(graph.const(0.01), sizes[pivot])
    return graph.div(graph.mul(graph.const(1.01), pivot), graph.add(graph.call("abs", pivot), share))


def _operands(graph: Graph, call: int) -> NodeList:
    """Return the scalar operands of a call, excluding results of other calls."""
    return [n for a in graph.args[call] if graph.op[a] == "array" for n in graph.args[a]]


def _with_equal_calls_once(generic: IdentityProbes, outputs: NodeList) -> NodeList:
    """Merge calls that compute equal values."""
    graph = generic.graph
    # sorted, so that no call is replaced by a call that depends on it
    calls = sorted(graph.calls(outputs), key=lambda call: (graph.operations(graph.args[call]), call))
    kept: dict = {}
    same: dict[int, int] = {}
    for call in calls:
        # array operands that come from other calls must be the same calls, not only of equal shape
        whole = tuple(
            (graph.value[a], *(same.get(other, other) for other in graph.args[a] if graph.op[a] != "array"))
            for a in graph.args[call]
        )
        alike = kept.setdefault((graph.value[call], whole), [])
        given = generic(_operands(graph, call))
        found = next(
            (other for other in alike if np.all(equal(given, generic(_operands(graph, other))))), None
        )
        if found is None:
            alike.append(call)
        else:
            same[call] = found
    return graph.substituted(outputs, same)


def may_be_massless(scene: Scene, structure: Structure) -> bool:
    """Return whether M is singular at the parameters of `scene`, if traced parameters are set to zero where
    they may be zero.

    These are parameters that are declared `non_negative` or have the default zero. If independent speeds are
    well conditioned, all parameters that are not declared `positive` are set to zero, because a singular M
    then costs nothing.
    """
    if structure.massless:
        return True
    without = _with_zeros(scene, every=structure.well_conditioned)
    if without is None:
        return False
    try:
        return structure_of(without).massless
    except ValueError:  # all of them cannot be zero at once, but some may be zero
        return True


def _with_zeros(scene: Scene, every: bool) -> Scene | None:
    """Return the scene with concrete parameters, zero where this is permitted; None if no parameter may be
    zero.
    """
    may_vanish = {
        f.name
        for f in fields(scene)
        if (every and not f.metadata.get("positive"))
        or f.metadata.get("non_negative")
        or np.array_equal(f.default, 0)
    }
    given, treedef = jax.tree_util.tree_flatten_with_path(scene)
    zeros = [is_traced(x) and jax.tree_util.keystr(path[:1]).strip(".") in may_vanish for path, x in given]
    leaves = [
        np.zeros_like(y) if zero else y
        for zero, y in zip(zeros, jax.tree.leaves(with_reference_parameters(scene)), strict=True)
    ]
    return jax.tree.unflatten(treedef, leaves) if any(zeros) else None
