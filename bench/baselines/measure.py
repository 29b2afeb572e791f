"""Operation counts and times of the baselines, one JSON object per line.

    XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1" taskset -c 0 python -m baselines.measure     (in `bench/`)

Times per evaluation are per lane, of batches of 4096 (by hand, one array per scalar) and 1024 (dense); the disc run is described in `disc_run`.
`--dense-run` adds the disc run by dense equations (minutes). States are from the models' domains, by `jourdain_jax`.
"""

import argparse
import json

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj

from . import dense, disc_run
from .hand_derived import ALTERNATIVES, HAND_DERIVED, operations
from .timing import fastest, seconds_per_evaluation

LANES_BY_HAND, LANES_DENSE = 4096, 1024


def random_states(name: str, lanes: int) -> tuple[jax.Array, jax.Array]:
    """Coordinates and speeds of a model on its rows, (lanes, coordinates) and (lanes, speeds)."""
    _, q, u = jj.sample_states(jj.models.MODELS[name](), lanes)
    return jnp.asarray(q), jnp.asarray(u)


def by_hand(name: str) -> float:
    """Seconds per evaluation and lane of hand-derived equations, one array of lanes per scalar."""
    known = HAND_DERIVED[name]
    scene = jj.models.MODELS[name]()
    q, u = random_states(name, LANES_BY_HAND)
    parameters = {key: getattr(scene, key) for key in known.parameters}
    state = tuple(q.T), tuple(u[:, scene.speed_names.entries.index(speed)] for speed in known.speeds)
    return seconds_per_evaluation(lambda y: known.rates(parameters, 0.0, *y), state, len(q))


def by_dense(name: str) -> float:
    """Seconds per evaluation and lane of the dense equations."""
    rates, parameters = {
        "tilting-disc": (dense.disc_rates, dense.DISC_PARAMETERS),
        "whipple-bicycle": (dense.bicycle_rates, dense.BICYCLE_PARAMETERS),
    }[name]
    y = jnp.concatenate(random_states(name, LANES_DENSE), axis=1)
    return seconds_per_evaluation(jax.vmap(lambda y: rates(parameters, 0.0, y)), y, len(y), evaluations=10)


def disc_runs(method: str, repeats: int) -> list[dict]:
    """The disc run to a final error of 1e-8 by each solver of diffrax."""
    starts, found = disc_run.starts(), []
    expected = disc_run.reference(starts)
    for solver, first in (("Dopri8", 1e-9), ("Tsit5", 1e-10), ("Dopri5", 1e-10)):
        run = disc_run.final_states(method, solver)
        tolerance, error = disc_run.loosest(lambda tolerance, run=run: run(tolerance, starts), expected, first)
        seconds = fastest(lambda run=run, tolerance=tolerance: run(tolerance, starts), repeats) / len(starts)
        found.append({"run": method, "solver": solver, "tolerance": tolerance, "error": error, "ms_per_trajectory": 1e3 * seconds})
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dense-run", action="store_true")
    options = parser.parse_args()
    print(json.dumps({"jax": jax.__version__, "numpy": np.__version__, "device": str(jax.devices()[0])}))
    for name in HAND_DERIVED | ALTERNATIVES:
        print(json.dumps({"equations": name, "operations": operations(name)}))
    for name in HAND_DERIVED:
        print(json.dumps({"equations": name, "by": "hand", "ns_per_evaluation": 1e9 * by_hand(name)}), flush=True)
    for name in ("tilting-disc", "whipple-bicycle"):
        print(json.dumps({"equations": name, "by": "dense", "ns_per_evaluation": 1e9 * by_dense(name)}), flush=True)
    for method, repeats in (("flat", 5), ("dense", 2))[: 1 + options.dense_run]:
        for line in disc_runs(method, repeats):
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
