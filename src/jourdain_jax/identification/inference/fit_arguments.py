"""Arguments that fits, likelihoods and plans share: options of their motions, and checked runs."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from jourdain_jax.calculus.reals import check_kind, described
from jourdain_jax.identification.data.data_warnings import oddities
from jourdain_jax.identification.data.experiment import Data, Experiment
from jourdain_jax.identification.data.run_preparation import checked
from jourdain_jax.motion.options import AllOptions, Options, as_options
from jourdain_jax.scene.arguments import BuiltFor, as_scene, warn
from jourdain_jax.scene.names import Labels
from jourdain_jax.scene.scene import Scene

_REFUSED = dict.fromkeys(
    ("start", "t0", "t1", "ts", "inputs", "events", "work"),
    "each `Experiment` states start, times and inputs, and its motion ends with its last sample",
)
_REFUSED["retry"] = "it computes each motion by one compiled method"


def as_fit_options(
    scene: Scene | BuiltFor, options: Options | None, by_name: Mapping, function: str
) -> AllOptions:
    """Return the options of the motions of a fit or a likelihood."""
    found = as_options(options, by_name, function, _REFUSED, scene)
    return replace(found, work=False, retry=False)


def as_runs(scene: Scene, data: Data, *, repeats: bool = False) -> tuple[Experiment, ...]:
    """Return one run or several as a tuple, checked against the scene. Raises ValueError as in `checked`, and
    if there is no run. Probable mistakes (`oddities`) cause warnings.
    """
    as_scene(scene)
    check_kind(data, Experiment | Iterable, "`data`", "an `Experiment` or a sequence of at least one")
    runs = (data,) if isinstance(data, Experiment) else tuple(data)
    if runs:
        wrong = [f"`data` holds {described(run)}" for run in runs if not isinstance(run, Experiment)]
    else:
        wrong = ["`data` is empty"]
    if wrong:
        raise ValueError(f"{wrong[0]}, expected an `Experiment` or a sequence of at least one")
    found = tuple(checked(scene, run, index, repeats) for index, run in enumerate(runs))
    for sentence in oddities(scene, found, repeats):
        warn(sentence)
    return found


def in_all_or_none(runs: Sequence[Experiment], what: str, unknown: Callable[[Experiment], Labels]) -> Labels:
    """Return the channels whose value is None and therefore estimated. Raises ValueError for a channel with
    None in one run and a value in another.
    """
    names = tuple(sorted({name for run in runs for name in unknown(run)}))
    for name in names:
        if any(name in run.values and name not in unknown(run) for run in runs):
            raise ValueError(
                f"{what} of channel `{name}` is None in one run and given in another; give it "
                "in all runs, or in none"
            )
    return names


def check_known(runs: Sequence[Experiment], what: str) -> None:
    """Raise ValueError if a sigma, or a number of a sensor or an actuator, is unknown."""
    for run in runs:
        for name in run.unknown_sigma:
            raise ValueError(
                f"sigma of channel `{name}` is None, but {what} needs the standard deviation of "
                "its noise; give a number"
            )
        for label in run.estimates:
            raise ValueError(
                f"`{label}` is to be estimated, but {what} needs its value; give a number, "
                "which may be traced, in place of the `Estimate`"
            )
