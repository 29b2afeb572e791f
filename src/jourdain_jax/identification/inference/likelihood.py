"""The likelihood of measurements, given a scene.

r = (reading - value) / sigma,   log L = - sum r^2 / 2 - sum log(sigma sqrt(2 pi))      (white noise)

The likelihood of measurements of disturbed motions, by an extended Kalman filter.

    x = (independent coordinates, independent speeds y),   y' = f(t, x) + w
    E w(t) w(t')' = W delta(t - t'),   W = diag(process noise)

    between samples   x <- x(t_k+1),   P <- F P F' + sum_j h w_j B_j W B_j'
                      B_j = F F_j^-1 [0; 1],   F_j = d x(s_j) / d x(t_k),   F = d x(t_k+1) / d x(t_k)
    at a sample       r = value - reading(x),   S = H P H' + R,   K = P H' S^-1,   H = d reading / d x
                      x <- x + K r,   P <- (1 - K H) P (1 - K H)' + K R K'
    log L             - sum (r' S^-1 r + log det S + n log 2 pi) / 2

P: covariance of x; R: covariance of the n readings; h: interval between two samples, with Gauss-Legendre
nodes s_j and weights w_j. Dependent coordinates and speeds follow from the constraints. The result is exact
for linear scenes; otherwise it is of first order in the spread of x. Source: A. H. Jazwinski, Stochastic
Processes and Filtering Theory (1970), section 8.3; G. J. Bierman, Factorization Methods for Discrete
Sequential Estimation (1977), section II.6 (Joseph's form of P).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.linear_matrices import (
    dependent_coordinates,
    others,
    privileged_at,
    privileged_speeds,
)
from jourdain_jax.calculus.reals import (
    Indices,
    Number,
    PerCoordinate,
    Scalar,
    Speeds,
    checked_real,
    holds,
    real_type,
)
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.identification.data.channels import Channel, Instrument, StopEvent
from jourdain_jax.identification.data.delay_filter import gauss_legendre
from jourdain_jax.identification.data.estimate import Correlated, Estimate
from jourdain_jax.identification.data.experiment import Data, Experiment, ideal
from jourdain_jax.identification.data.run_preparation import as_fit_options, as_runs, check_known
from jourdain_jax.identification.inference.correlated_noise import log_densities
from jourdain_jax.identification.solve.run_groups import equal_runs
from jourdain_jax.identification.solve.shooting import Run
from jourdain_jax.integrate.inputs import Inputs, as_inputs, inputs_at
from jourdain_jax.integrate.state import State
from jourdain_jax.motion.options import AllOptions, OptionFields, Options
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.motion.start import consistent
from jourdain_jax.motion.start import start as consistent_start
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines
from jourdain_jax.scene.coordinates import Labels, nearest
from jourdain_jax.scene.scene import Scene


def log_likelihood(
    scene: Scene | BuiltFor, data: Data, *, options: Options | None = None, **by_name: Unpack[OptionFields]
) -> Scalar:
    """Return the logarithm of the probability density of the measurements `data` (one run or several): `- sum
    r^2 / 2 - sum log(sigma sqrt(2 pi))`.

    The result is differentiable with respect to the scene, start values, measured values, sigmas, parameters
    of sensors and actuators, and known correlation times of the noise (by reverse mode, unless `adjoint`
    requests another). It is -inf if the motion fails. Missing samples (NaN, or an infinite sigma) are
    omitted. `options`, `by_name`: as in `simulate`.

        jax.grad(lambda a: jj.identification.log_likelihood(sleigh.replace(offset=a), data))(0.25)

    **Raises** ValueError for measurements that do not fit the scene.
    """
    settled = as_fit_options(scene, options, by_name, "log_likelihood")
    scene = as_scene(scene)
    runs = as_runs(scene, data)
    if unknown := sorted({name for run in runs for name in run.unknown_correlation}):
        raise ValueError(
            f"the correlation time of channel `{unknown[0]}` is None, but a likelihood needs it; give a "
            "number in s, or 0 for white noise"
        )
    check_known(runs, "a likelihood")
    of = partial(of_run, scene, options=settled)
    return jnp.sum(jnp.stack([jnp.sum(mapped(of, run)) for _, run in equal_runs(runs)]))


def of_run(scene: Scene, run: Run, *, options: AllOptions) -> Scalar:
    """Return the logarithm of the density of the measurements of one run; -inf if its motion fails."""
    found = sum(map(jnp.sum, of_samples(scene, run, options=options).values()), jnp.zeros(()))
    return jnp.where(jnp.isfinite(found), found, -jnp.inf)


def of_samples(scene: Scene, run: Run, *, options: AllOptions) -> dict[str, Array]:
    """Return the logarithm of the density of each sample by channel: zero for a missing one, and given the
    samples before it if noise is correlated.
    """
    found = {}
    for name, r in run.residuals(scene, simulate, options).items():
        weight = run.weights[name]
        counted = weight > 0
        # log sigma = - log weight
        logs = jnp.log(jnp.where(counted, weight, 1.0) / jnp.sqrt(2 * jnp.pi))
        tau = run.correlation_time.get(name)
        of_r = -0.5 * r**2 if tau is None else log_densities(r, weight, run.ts, tau)
        found[name] = jnp.where(counted, logs, 0.0) + of_r
    return found


def mapped(f: Callable, runs: Run, *more: Array):
    """Return `f(run, *more)` for each of the stacked runs. A single run is not batched, since batches use
    wider, slower registers.
    """
    if runs.ts.shape[0] > 1:
        return eqx.filter_vmap(f)(runs, *more)
    found = f(*jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, (runs, *more)))
    return jax.tree.map(lambda x: x[None], found)


_NODES, _WEIGHTS = gauss_legendre(5)


@shown_from_users_lines
def filtered_log_likelihood(
    scene: Scene | BuiltFor,
    data: Data,
    *,
    process_noise: "Mapping[str, Number]",
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> Scalar:
    """Return the log-likelihood for a motion with process noise, by an extended Kalman filter. Process noise
    disturbs the motion itself, as a rider or rough ground does.

    **Arguments**

    - `data`: one run or several. Each start value is known, or has an `Estimate(prior=Normal(mean, sigma))`
      in `unknown_start`, its distribution at the start. Sensors must have no delay and no lag, and only known
      numbers.
    - `process_noise`: independent speed -> intensity q of a white disturbance of its rate, in (unit of the
      speed)^2 / s: in a time t, it adds q t to the variance of the speed. Speeds without an entry are not
      disturbed. The independent speeds are `scene.privileged`, or the engine's choice.
    - `options`, `by_name`: as in `simulate`.

    The motion between samples and its derivatives with respect to the state come from `simulate`. The
    likelihood is exact for linear scenes; for others the covariance of the state is propagated to first
    order. Without process noise and with a known start it equals `log_likelihood`.

    The result is differentiable with respect to parameters, start values, sigmas and intensities in forward
    mode (`jax.jacfwd`), also under `jit` and `vmap`. It is -inf if the motion fails. Make sensors outside of
    `jit`, since a traced delay cannot be checked.

    **Raises** ValueError for a name that is not an independent speed, intensities below zero, quaternions,
    sensors with a delay or lag, accelerometers, noise with a correlation time, and unknown numbers.

    **Example**

        noise = {"heading_rate": 0.01}  # (rad/s)^2 / s
        jj.identification.filtered_log_likelihood(sleigh, run, process_noise=noise)
    """
    settled = replace(as_fit_options(scene, options, by_name, "filtered_log_likelihood"), events=False)
    scene = as_scene(scene)
    runs = as_runs(scene, data)
    _check_supported(scene, runs)
    total = jnp.zeros(())
    for numbers, alike in equal_runs(runs):
        speeds = _independent_speeds(scene, runs[numbers[0]])
        intensities = _intensities(scene, speeds, process_noise)
        names = tuple(dict.fromkeys(name for i in numbers for name in runs[i].unknown_start))

        def one(
            run: Run, begun: Float[Array, "2 unknown"], names=names, known=(speeds, intensities)
        ) -> Scalar:
            mean, sigma = begun
            run = run._replace(start=run.start | dict(zip(names, mean, strict=True)))
            return _Filter(scene, run, settled, *known).log_likelihood(names, sigma)

        total = total + jnp.sum(mapped(one, alike, jnp.stack([_begun(runs[i], names) for i in numbers])))
    return jnp.where(jnp.isfinite(total), total, -jnp.inf)


class _Filter:
    """The filter of one run."""

    def __init__(self, scene: Scene, run: Run, options: AllOptions, speeds: Indices, intensities: Speeds):
        assert isinstance(run.inputs, Inputs)  # for a run that was checked
        self.scene, self.run, self.inputs, self.options = scene, run, run.inputs, options
        self.speeds, self.intensities = np.array(speeds, int), intensities
        self.begin = self._start(run.start)
        count = len(scene.coordinate_names)
        self.coordinates = others(dependent_coordinates(scene, self.begin, (), None), count)
        self.held = (
            *(scene.coordinate_names.entries[i] for i in self.coordinates),
            *(scene.speed_names.entries[i] for i in speeds),
        )

    def log_likelihood(self, unknown: Labels, sigma: Float[Array, "unknown"]) -> Scalar:
        """Return the log-likelihood of all samples; `sigma`: standard deviations of start values."""
        run, begin = self.run, self.begin
        x = self._independent(begin.q, begin.u)
        P = jnp.zeros((x.size, x.size))
        if unknown:

            def begun(values: Float[Array, "unknown"]) -> Float[Array, "states"]:
                state = self._start(run.start | dict(zip(unknown, values, strict=True)))
                return self._independent(state.q, state.u)

            J = jax.jacfwd(begun)(jnp.stack([run.start[name] for name in unknown]))
            P = (J * sigma**2) @ J.T
        names = sorted(run.weights)
        flat = lambda parts: jnp.concatenate(
            [parts[name].reshape(run.ts.shape[0], -1) for name in names], axis=1
        )

        def step(carry, sample):
            t, q, x, P, total = carry
            t1, values, weights = sample
            q, x, P = self._propagated(t, t1, q, x, P)
            x, P, more = self._updated(t1, q, x, P, values, weights)
            return (t1, q, x, P, total + more), None

        carry = jnp.asarray(run.t0), begin.q, x, P, jnp.zeros(())
        return jax.lax.scan(step, carry, (jnp.asarray(run.ts), flat(run.values), flat(run.weights)))[0][-1]

    def _start(self, values: dict) -> State:
        return consistent_start(self.scene, t0=self.run.t0, inputs=self.run.inputs, **values)

    def _independent(self, q, u) -> Float[Array, "*times states"]:
        return jnp.concatenate([q[..., self.coordinates], u[..., self.speeds]], axis=-1)

    def _state(self, t, q: PerCoordinate, x: Float[Array, "states"]) -> State:
        """Return the state with these independent coordinates and speeds. The others follow from the
        constraints, with coordinates near q.
        """
        count = len(self.coordinates)
        q = jax.lax.stop_gradient(q).at[self.coordinates].set(x[:count])
        u = jnp.zeros(len(self.scene.speed_names)).at[self.speeds].set(x[count:])
        return consistent(self.scene, t, q, u, inputs_at(self.inputs, t), held=self.held)

    def _propagated(self, t, t1, q, x, P):
        """Return q, x, P at the time t1, which may equal t."""
        moves = t1 > t
        span = jnp.where(moves, t1 - t, (self.run.ts[-1] - self.run.t0) / self.run.ts.shape[0])
        times = jnp.hstack([t + span * jnp.asarray(_NODES), jnp.where(moves, t1, t + span)])

        def later(x):
            motion = simulate(
                self.scene, self._state(t, q, x), t0=t, ts=times, inputs=self.run.inputs, options=self.options
            )
            found = self._independent(motion.q, motion.u)
            return found, (found[-1], motion.q[-1])

        slopes, (x1, q1) = jax.jacfwd(later, has_aux=True)(x)
        F, into = slopes[-1], jnp.eye(x.size)[:, len(self.coordinates) :]
        B = jax.vmap(lambda F_j: F @ jnp.linalg.solve(F_j, into))(slopes[:-1])
        added = span * jnp.einsum("j,jik,k,jlk->il", _WEIGHTS, B, self.intensities, B)
        return tuple(jnp.where(moves, new, old) for new, old in ((q1, q), (x1, x), (F @ P @ F.T + added, P)))

    def _updated(self, t, q, x, P, values, weights):
        """Return x and P after the samples at one time, and the logarithm of their density. Samples of zero
        weight are missing.
        """

        def shown(x):
            found = self._shown(t, self._state(t, q, x))
            return found, found

        H, reading = jax.jacfwd(shown, has_aux=True)(x)
        there = weights > 0
        H, r = jnp.where(there[:, None], H, 0.0), jnp.where(there, values - reading, 0.0)
        R = jnp.where(there, 1 / jnp.where(there, weights, 1.0) ** 2, 1.0)
        L = jnp.linalg.cholesky(H @ P @ H.T + jnp.diag(R))
        K = jax.scipy.linalg.cho_solve((L, True), H @ P).T
        rest = jnp.eye(x.size) - K @ H
        white = jax.scipy.linalg.solve_triangular(L, r, lower=True)
        more = (
            -0.5 * white @ white
            - jnp.sum(jnp.log(jnp.diagonal(L)))
            - 0.5 * jnp.sum(there) * jnp.log(2 * jnp.pi)
        )
        return x + K @ r, rest @ P @ rest.T + (K * R) @ K.T, more

    def _shown(self, t, state: State) -> Float[Array, "channels"]:
        found = []
        for name in sorted(self.run.weights):
            sensor = self.run.sensors.get(name, ideal(name))
            operation = sensor.operation
            if isinstance(operation, Channel):
                x = operation(motion_at(self.scene, t, state.q, state.u, self.inputs(t)))
            else:
                x = state[sensor.name]
            found.append(jnp.ravel(sensor.shown(x[None], None, None)[0]))
        return jnp.concatenate(found)


def _check_supported(scene: Scene, runs: Sequence[Experiment]) -> None:
    if scene.coordinates.quaternions:
        raise ValueError(
            f"`{type(scene).__name__}` has quaternions, whose covariance the filter does not "
            "support; use a scene with angles as coordinates"
        )
    check_known(runs, "a filter")
    for index, run in enumerate(runs):
        for name in (*run.correlation_time, *run.unknown_correlation):
            raise ValueError(
                f"the noise of channel `{name}` has a correlation time, but the filter assumes white noise; "
                "omit `correlation_time`"
            )
        for name, reading in run.readings.items():
            if isinstance(reading.operation, StopEvent):
                raise ValueError(
                    f"run {index} gives the time of its event `{name}`, which the filter does "
                    "not use; omit this time, and the samples after it"
                )
            which = f"sensor `{name}` of run {index}"
            if reading.is_late:
                raise ValueError(
                    f"{which} has a delay or a lag, which the filter does not support; shift "
                    "its times by the delay, or use `fit`"
                )
            if isinstance(reading.operation, Instrument):
                raise ValueError(
                    f"{which} measures accelerations, which contain the white disturbance "
                    "itself; omit the channel, or use `fit`"
                )
        for name, given in run.unknown_start.items():
            if not isinstance(given, Estimate) or given.prior is None or isinstance(given.prior, Correlated):
                raise ValueError(
                    f"start value `{name}` of run {index} is unknown, but has no prior; give "
                    "`jj.Estimate(prior=jj.studies.Normal(mean, sigma))`"
                )


def _independent_speeds(scene: Scene, run: Experiment) -> Indices:
    """Return the scene's independent speeds. If these do not determine the other speeds at a known start,
    return independent speeds chosen for that start.
    """
    usual, inputs = privileged_speeds(scene), as_inputs(scene, run.inputs)
    begin = consistent_start(scene, t0=run.t0, inputs=inputs, **run.start)

    def at_start() -> Indices:
        return privileged_at(scene, begin, inputs_at(inputs, run.t0), usual)

    determined = scene.privileged is not None or holds(
        lambda *_: at_start() == usual, *jax.tree.leaves((scene, begin))
    )
    return usual if determined else at_start()


def _intensities(scene: Scene, speeds: Indices, given: Mapping) -> Speeds:
    names = [scene.speed_names.entries[i] for i in speeds]
    if not isinstance(given, Mapping):
        raise ValueError(
            f"`process_noise` is {given!r}, expected a dictionary: independent speed -> "
            "intensity in (unit of the speed)^2 / s"
        )
    found = dict.fromkeys(names, jnp.zeros(()))
    for name, value in given.items():
        if name not in names:
            raise ValueError(
                f"`process_noise` names `{name}`, which is not an independent speed of "
                f"`{type(scene).__name__}`; {nearest(name, names)} To choose others, set `privileged` in the "
                "scene."
            )
        number = checked_real(value, f"process noise of `{name}`", (), advice="give one number")
        if not holds(lambda x: np.isfinite(x) & (x >= 0), number):
            raise ValueError(f"process noise of `{name}` is {float(number):g}, expected zero or more")
        found[name] = number.astype(real_type())
    return jnp.stack(list(found.values())) if found else jnp.zeros(0)


def _begun(run: Experiment, names: Labels) -> Float[Array, "2 unknown"]:
    """Return means and standard deviations of these start values."""
    given: dict[str, Any] = dict(run.unknown_start)  # estimates with priors
    known = [
        (given[name].prior.mean, given[name].prior.sigma) if name in given else (run.start[name], 0.0)
        for name in names
    ]
    return jnp.array(known, real_type()).reshape(-1, 2).T
