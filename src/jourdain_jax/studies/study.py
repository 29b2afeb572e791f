"""A study: the variation over many motions of one scene, and how they are run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Unpack

import numpy as np

from jourdain_jax.calculus.files import FilePath
from jourdain_jax.calculus.reals import checked_real, checked_whole, described
from jourdain_jax.motion.model import Model, build
from jourdain_jax.motion.options import MotionFields, Options, as_options
from jourdain_jax.motion.simulate import span_and_times
from jourdain_jax.scene.arguments import as_scene
from jourdain_jax.scene.coordinates import check_name, parameters_of
from jourdain_jax.scene.printing import Printed
from jourdain_jax.studies.design import MOST_SAMPLES, Design, Distribution, Levels
from jourdain_jax.studies.mean_gradients import MeanGradients, mean_gradients
from jourdain_jax.studies.memory import of_each
from jourdain_jax.studies.outputs import AT_START, SAVES, Integral, Task, as_outputs
from jourdain_jax.studies.result import StudyResult
from jourdain_jax.studies.run import bounded, in_this_process, run
from jourdain_jax.studies.workers import in_processes, on_cluster

_STATED = "give saved times as `ts`; `outputs` and `save` choose the stored results"
REFUSED = dict.fromkeys(("progress", "parameters", "starts", "scene", "start"), _STATED)
REFUSED["every"] = "`keep_every=N` stores the trajectory of every N-th sample"


class TaskFields(MotionFields, total=False):
    """Arguments of a run of a study, by name."""

    t0: Any
    t1: Any
    ts: Any
    outputs: Mapping | None
    save: str
    keep_every: int | None
    options: Options | None


@dataclass(frozen=True, repr=False)
class Study(Printed):
    """Many motions of one scene with varying parameters or start values.

    - `scene`; `vary`: parameter -> its variation; `start`: coordinate or speed -> its variation, or one
      number for all samples (other values follow from the constraints, as in `jj.start`; default: the scene's
      example). A variation is a distribution (`jj.studies.Normal`, `jj.studies.Uniform`,
      `jj.studies.LogNormal`, `jj.studies.LogUniform`), `jj.studies.Levels` of a grid, or a list with one
      number per sample; all must be of one kind.
    - `sampler`, `samples`, `seed`, `correlation`: as in `jj.studies.Design`. Sample k depends only on the
      seed and k.

        disc = jj.models.TiltingDisc()
        start = {"lean": jj.studies.Uniform(-0.6, 0.6), "spin_rate": -3.0}
        vary = {"radius": jj.studies.Normal(0.5, 0.01)}
        study = jj.Study(disc, vary=vary, start=start, sampler="sobol", samples=1024)
        outputs = {"lean": jj.studies.End("lean", "rad"), "fallen": jj.studies.Happened("fallen")}
        result = study.run("discs.zarr", t1=2.0, outputs=outputs)
        print(result)

    Raises ValueError for unknown names and for quantities that cannot vary. Needs the extra `studies`.
    """

    scene: Any  # a scene, or a model, from which the scene is taken
    vary: Any = None  # dictionaries by name; `correlation` by pairs of names
    start: Any = None
    sampler: str = "random"
    samples: int | None = None
    seed: int = 0
    correlation: Any = None
    # the samples: parameters by name, start values by name with the suffix `_at_start`
    design: Design = field(init=False, repr=False, compare=False)
    _given: Any = field(init=False, repr=False, compare=False)  # the scene, or its model
    _constants: dict = field(init=False, repr=False, compare=False)  # start values that do not vary

    def __post_init__(self):
        object.__setattr__(self, "_given", self.scene)
        object.__setattr__(self, "scene", as_scene(self.scene))
        varying, constants = self._named()
        object.__setattr__(self, "_constants", constants)
        column = {name: name + AT_START for name in self.start or ()} | {
            name: name for name in self.vary or ()
        }
        pairs = {
            tuple(column.get(x, x) for x in pair) if isinstance(pair, tuple) else pair: value
            for pair, value in (self.correlation or {}).items()
        }
        object.__setattr__(
            self, "design", Design(varying, self.sampler, self.samples, self.seed, pairs or None)
        )

    def _named(self) -> tuple[dict, dict]:
        """Return the varying quantities, by the names of their columns, and the constant start values."""
        examples = {
            "vary": '{"mass": jj.studies.Normal(12.0, 0.3)}',
            "start": '{"lean": 0.3}',
            "correlation": '{("mass", "radius"): 0.5}',
        }
        for what, example in examples.items():
            if (given := getattr(self, what)) is not None and not isinstance(given, Mapping):
                raise ValueError(
                    f"`{what}` is {described(given)}, expected a dictionary by name, such as {example}"
                )
        known = {name: np.ndim(value) for name, value, _ in parameters_of(self.scene)}
        varying = {}
        for name, how in (self.vary or {}).items():
            check_name(name, known, f"scene `{type(self.scene).__name__}` has no parameter `{name}`")
            if known[name]:
                raise ValueError(
                    f"parameter `{name}` is an array, but only single numbers can vary: vary a "
                    "parameter from which the scene makes that array"
                )
            if np.ndim(how) == 0 and not isinstance(how, Distribution | Levels):
                raise ValueError(
                    f"parameter `{name}` is to vary as {described(how)}; set one value on the scene itself, "
                    "or give a distribution"
                )
            varying[name] = how
        q, u = self.scene.coordinate_names, self.scene.speed_names
        groups = {group for names in (q, u) for group, _, _ in names.groups}
        constants = {}
        for name, how in (self.scene.example if self.start is None else self.start).items():
            what = f"`{type(self.scene).__name__}` has no coordinate or speed `{name}` to start with"
            check_name(name, (*q, *u, *groups), what)
            if not isinstance(how, Distribution | Levels) and (np.ndim(how) == 0 or name in groups):
                checked_real(how, f"start `{name}`", advice="give its value")
                constants[name] = how
            elif name in groups:
                raise ValueError(
                    f"start `{name}` is a vector, but only single numbers can vary: vary its entries"
                )
            else:
                varying[name + AT_START] = how
        return varying, constants

    def task(
        self,
        *,
        t1=None,
        ts=None,
        t0=None,
        outputs: Mapping | None = None,
        save: str = "outputs",
        keep_every: int | None = None,
        inputs=None,
        options=None,
        **by_name,
    ) -> Task:
        """Return a description of everything that determines the results of a run. The arguments are those of
        `run`: `t1`, `ts`, `t0` in s, `outputs`, `save`, `keep_every`, `inputs`, `options`, `by_name`.
        """
        check_name(save, SAVES, f"`save` is {save!r} (trajectories are kept by `keep_every=1`)")
        if keep_every is not None:
            expected = "of at least 1, or None to store no trajectories"
            keep_every = checked_whole(keep_every, "`keep_every`", 1, MOST_SAMPLES, expected=expected)
        options = replace(as_options(options, by_name, "Study.run", REFUSED, self._given), memory=None)
        if (
            isinstance(self._given, Model)
            and self._given.formulation == build(self.scene, backend=options.backend).formulation
        ):
            # the scene's own formulation: a study may continue with another memory bound
            options = replace(options, formulation=None)
        known = as_outputs(self.scene, outputs)
        first, times, last = span_and_times(self.scene, None, t0, t1, ts)
        if ts is None and keep_every is None and not any(output.over_times for output in known.values()):
            times = last[None]
        if times[0] != first and (
            missed := [name for name, output in known.items() if isinstance(output, Integral)]
        ):
            text = (
                f"`ts` begins at {times[0]:g} s, and the motion at {first:g} s: the integral `{missed[0]}`"
                " would omit the time between"
            )
            raise ValueError(f"{text}; begin `ts` at the start of the motion")
        span = {"t0": float(first), "t1": float(last), "ts": np.asarray(times, float), "inputs": inputs}
        return Task(self.scene, self.design, self._constants, known, span, options, save, keep_every)

    def run(
        self,
        path: FilePath,
        *,
        chunk: int | None = None,
        progress: bool = True,
        processes: int = 1,
        client: Any = None,
        shard: tuple[int, int] = (1, 1),
        command: str = "",
        **what: Unpack[TaskFields],
    ) -> StudyResult:
        """Compute the missing part of the study in the folder `path`, which is created if necessary, and
        return its results.

        The same call on the same folder continues an earlier run, however that ended. Results have the same
        bits for all `chunk` sizes, orders and interruptions.

        - `t0`, `t1`: span (s; default: 0 and the scene's `example_span`); `ts`: times (s) at which outputs
          are evaluated (default: 201 equidistant ones; only the end if all outputs use only the end).
        - `outputs`: name -> `jj.studies.End`, `jj.studies.Largest`, `jj.studies.Smallest`,
          `jj.studies.LargestMagnitude`, `jj.studies.Integral`, `jj.studies.EventTime`, `jj.studies.Happened`,
          `jj.studies.Quantity`, or a function of a trajectory; default: the end values of all coordinates and
          speeds. They are NaN for failed motions.
        - `save`: "outputs" stores parameters, starts, outputs, result code and steps of every sample;
          "statistics" stores only counts, sums and histograms.
        - `keep_every`: an interval of samples. 1000 stores the states at `ts` of every thousandth sample, and
          with save="statistics" also its other results; 1 those of all samples, None those of no sample.
        - `chunk`: number of samples stored together (default: about a thousandth of all); after a crash at
          most one chunk is computed again.
        - `processes`: the number of computing processes, each with its share of the cores. If there are
          several, guard the top level of your script by `if __name__ == "__main__":`, and define outputs
          outside of functions.
        - `client`: a `dask.distributed.Client`. Each of its workers computes one chunk at a time and must
          have access to the folder.
        - `shard`: (k, n) computes only the k-th of n shares of the chunks. Use a separate folder on each of n
          machines, and combine them by `jj.studies.merge_studies`.
        - `progress`: show a bar; `command`: text stored with the study.
        - `options`: a `jj.Options`, or its fields by name; `inputs`: as in `rollout`. These, and `t0` to
          `keep_every` above, are `what` in the signature.

        If the scene is a model, `jj.build(scene, memory="2GB")`, its memory bounds all computing processes of
        this machine together, including the present one; with `client`, it bounds each worker. Blocks and
        chunks are sized accordingly, and on Linux the bound is enforced. Block sizes affect the last digits
        of means and covariances.

        Raises ValueError if the folder holds another study, or if its disk or the memory is too small. A
        sample takes 8 bytes per stored number; there are at most 2^44 samples by default. Raises MemoryError
        if the memory was exceeded, `InUseError` if another process runs the study, and OSError if the folder
        cannot be written. Ctrl-C finishes the current chunk, stores all results, and raises
        KeyboardInterrupt.
        """
        task = self.task(**what)
        if [type(x) for x in shard] != [int, int] or not 1 <= shard[0] <= shard[1]:
            raise ValueError(f"`shard` is {shard}, expected (k, n) with 1 <= k <= n")
        checked_whole(processes, "`processes`", 1, expected="of at least 1")
        if client is not None and processes != 1:
            raise ValueError(
                "`client` and `processes` are both given; give one of them: the workers of a "
                "cluster, or processes of this machine"
            )
        here = client is None and processes == 1
        memory = self._given.memory if isinstance(self._given, Model) else None
        task, chunk = bounded(
            task, path, chunk, None if memory is None else of_each(memory, processes), here=here
        )
        if here:
            compute = partial(in_this_process, task)
        else:
            compute = in_processes(task, processes) if client is None else on_cluster(task, client)
        store = run(task, path, chunk=chunk, progress=progress, shard=shard, command=command, workers=compute)
        return StudyResult(store, task)

    def mean_gradients(self, *, parameters: Sequence[str] = (), **what: Unpack[TaskFields]) -> MeanGradients:
        """Return derivatives of the means of all outputs with respect to parameters of the distributions,
        and to shared `parameters`.

        They are pathwise derivatives: means of the exact derivatives of the samples' motions, in forward
        mode. If samples end at events, a `SensitivityWarning` (also in `warnings` of the result) names the
        missing part. The computation runs in this process, and nothing is stored.

        - `what`: `t0`, `t1`, `ts`, `outputs`, `inputs` and options, as in `run`.

            outputs = {"final lean": jj.studies.End("lean", "rad")}
            found = study.mean_gradients(t1=2.0, outputs=outputs, parameters=("gravity",))
            found.of("final lean", "radius.sigma")

        Raises ValueError for unknown names.
        """
        return mean_gradients(self.task(**what), tuple(parameters))

    def _text(self) -> str:
        constants = ", ".join(
            f"{name} = {np.asarray(value).tolist()}" for name, value in self._constants.items()
        )
        return f"Study of {type(self.scene).__name__}\n{self.design}" + (
            f"\n  all start with {constants}" if constants else ""
        )
