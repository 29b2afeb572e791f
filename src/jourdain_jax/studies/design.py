"""The samples of a study: values of the varying quantities, for any range of sample indices.

Correlated normal distributions: with independent standard normal z = Phi^-1(u) and the Cholesky factor L of
the correlation matrix, L z has that correlation. Phi(L z) replaces the probability u of a quantity, and its
distribution maps this to a value. So any distributions can have correlated ranks; normal distributions have
the stated correlation itself.

Parameters and start values vary by distributions, or by levels of a grid. A distribution maps uniform numbers
u in (0, 1) to values by its inverse distribution function. A sampler that spreads u evenly (Latin hypercube,
Sobol) therefore spreads the values well.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import all_finite, checked_known, checked_whole, described, has_unit
from jourdain_jax.scene.coordinates import Labels, check_names, nearest
from jourdain_jax.scene.printing import Printed
from jourdain_jax.studies.samplers import (
    MOST_SOBOL,
    SAMPLERS,
    correlated,
    exponential,
    normal_quantile,
    product,
)


class Distribution:
    """Base of the distributions: `values(u)` is the inverse distribution function."""

    _positive: ClassVar[str] = ""  # name of the number that must be positive

    def __post_init__(self):
        """Convert the numbers to floats. Raises ValueError if one is not finite, or out of range."""
        kind, known = type(self).__name__, dict(vars(self))
        for name, value in known.items():
            known[name] = float(checked_known(value, f"`{name}` of {kind}", (), advice="give one number"))
            object.__setattr__(self, name, known[name])
            if not np.isfinite(known[name]):
                raise ValueError(f"`{name}` of {kind} is {value}, expected a finite number")
        if known.get("sigma", 0.0) < 0:
            raise ValueError(f"`sigma` of {kind} is {known['sigma']:g}, expected a standard deviation >= 0")
        if not known.get("low", 0.0) < known.get("high", 1.0):
            raise ValueError(
                f"{kind} has low = {known['low']:g} and high = {known['high']:g}, expected low < high"
            )
        if self._positive and known[self._positive] <= 0:
            raise ValueError(
                f"`{self._positive}` of {kind} is {known[self._positive]:g}, expected a positive number"
            )

    def values(self, u):
        """Return the values at the probabilities `u`, between 0 and 1."""
        return self._inverse(u, *vars(self).values())

    def derivatives(self, u: np.ndarray) -> dict[str, np.ndarray]:
        """Return derivatives of `values(u)` with respect to the parameters of the distribution, by name. They
        are computed by complex steps, exact to round-off.
        """
        known, tiny = vars(self), 1e-30
        return {
            name: np.imag(self._inverse(u, *(known | {name: known[name] + 1j * tiny}).values())) / tiny
            for name in known
        }

    @staticmethod
    @abstractmethod
    def _inverse(u: np.ndarray, first, second) -> np.ndarray:
        """Return the values at the probabilities `u`. The result is an analytic function of the numbers
        `first` and `second`.
        """


@dataclass(frozen=True)
class Normal(Distribution):
    """A normal distribution with the given `mean` and standard deviation `sigma`, in the unit of the
    quantity; constant for sigma = 0.
    """

    mean: Any
    sigma: Any

    @staticmethod
    def _inverse(u, mean, sigma):
        return mean + product(sigma, normal_quantile(u), u)


@dataclass(frozen=True)
class Uniform(Distribution):
    """A uniform distribution between `low` and `high`, in the unit of the quantity."""

    low: Any
    high: Any

    @staticmethod
    def _inverse(u, low, high):
        return low + product(high - low, u, u)


@dataclass(frozen=True)
class LogNormal(Distribution):
    """A positive quantity whose logarithm is normal: `median` in the unit of the quantity, `sigma` the
    standard deviation of its natural logarithm.
    """

    median: Any
    sigma: Any
    _positive = "median"

    @staticmethod
    def _inverse(u, median, sigma):
        return median * exponential(product(sigma, normal_quantile(u), u), u)


@dataclass(frozen=True)
class LogUniform(Distribution):
    """A positive quantity whose logarithm is uniformly distributed between the logarithms of `low` and
    `high`, in the unit of the quantity.
    """

    low: Any
    high: Any
    _positive = "low"

    @staticmethod
    def _inverse(u, low, high):
        return low * exponential(product(np.log(high / low), u, u), u)


@dataclass(frozen=True)
class Levels:
    """The `levels` of a quantity in a grid, in its unit. A grid has all combinations of levels; the last
    quantity varies fastest.
    """

    levels: tuple[float, ...]

    def __init__(self, levels: Sequence[float]):
        found = np.asarray(checked_known(levels, "`levels`", advice="give a list of numbers"), float)
        if found.ndim != 1 or not found.size or not all_finite(found):
            raise ValueError(
                f"`levels` has the shape {found.shape}, expected a list of finite numbers, at least one"
            )
        object.__setattr__(self, "levels", tuple(found.tolist()))


GRID, TABLE = "grid", "table"
MOST_SAMPLES = 2**53  # numerics: integers that floats represent exactly
MOST_CROSSED = 2**62  # numerics: samples of a grid, counted in 64 bits


@dataclass(frozen=True, repr=False)
class Design(Printed):
    """The samples of a study: names and distributions of varying quantities, sampler, and number of samples.

    - `variables`: name -> a distribution (`Normal`, `Uniform`, `LogNormal`, `LogUniform`), `Levels` of a
      grid, or a column of a table (one number per sample). All must be of one kind.
    - `sampler`: "random", "latin-hypercube", "sobol", or "saltelli" (for Sobol' indices); not for grids and
      tables.
    - `samples`: number of samples. A grid has all combinations of its levels, a table one sample per row.
    - `seed`: seed of the random numbers. Sample k depends only on the seed and k (in a Latin hypercube also
      on the number of samples).
    - `correlation`: pair of names -> correlation coefficient of two normal distributions; of other
      distributions, the correlation of the normal scores of their ranks.

        vary = {"mass": jj.studies.Normal(12.0, 0.3), "radius": jj.studies.Uniform(0.3, 0.4)}
        design = jj.studies.Design(vary, sampler="sobol", samples=1024, seed=7)
        design.values(0, 8)["mass"]  # of samples 0 to 7, in kg
    """

    variables: Mapping
    sampler: str = "random"
    samples: int | None = None
    seed: int = 0
    correlation: Mapping | None = None
    _factor: np.ndarray | None = field(default=None, init=False)

    def __post_init__(self):
        kinds = {self._kind(name, what) for name, what in self.variables.items()}
        if len(kinds) != 1:
            found = "nothing varies" if not kinds else f"there are {' and '.join(sorted(kinds))} at once"
            raise ValueError(
                f"{found}; give distributions, or `Levels` of a grid, or the columns of one table"
            )
        kind = kinds.pop()
        checked_whole(self.seed, "`seed`", 0, 2**63 - 1, expected="from 0 to 2^63 - 1")
        if kind == "distributions":
            self._check_sampler()
        else:
            self._check_given(GRID if kind == "levels" else TABLE)
        object.__setattr__(self, "_factor", self._cholesky())

    @staticmethod
    def _kind(name: str, what) -> str:
        if isinstance(what, Distribution):
            return "distributions"
        if isinstance(what, Levels):
            return "levels"
        try:
            column = np.empty(0) if has_unit(what) else np.asarray(what)
        except ValueError:  # rows of unequal length
            column = np.empty(0)
        if column.ndim != 1 or column.dtype.kind not in "fiu" or not column.size:
            raise ValueError(
                f"`{name}` varies as {described(what)}, expected a distribution such as "
                "jj.studies.Normal(0, 1), jj.studies.Levels([...]) or a list of numbers"
            )
        if not all_finite(column):
            raise ValueError(
                f"the column `{name}` has {int(np.sum(~np.isfinite(column)))} entries that are not finite; "
                "omit these rows"
            )
        return "columns"

    def _check_sampler(self) -> None:
        if self.sampler in (GRID, TABLE):
            name, what = next(iter(self.variables.items()))
            raise ValueError(
                f"a {self.sampler} takes"
                f" {'`jj.studies.Levels`' if self.sampler == GRID else 'columns of numbers'}, but `{name}`"
                f" varies as {what!r}"
            )
        if not isinstance(self.sampler, str) or self.sampler not in SAMPLERS:
            raise ValueError(
                f"unknown sampler `{self.sampler}`; {nearest(str(self.sampler), SAMPLERS)} "
                "Grids take `jj.studies.Levels`, tables columns."
            )
        samples = checked_whole(
            self.samples, "`samples`", 1, MOST_SAMPLES, expected=f"of at least 1 and at most {MOST_SAMPLES}"
        )
        if self.sampler in ("sobol", "saltelli") and samples > MOST_SOBOL:
            raise ValueError(
                f"`samples` is {samples}, expected at most {MOST_SOBOL} for a Sobol sequence; "
                "take sampler='random'"
            )
        group = len(self.variables) + 2
        if self.sampler == "saltelli" and (samples % group or self.correlation):
            if self.correlation:
                wrong = "variables are correlated, for which Sobol' indices are not defined"
            else:
                wrong = f"`samples` is {samples}"
            raise ValueError(
                f"{wrong}; sampler 'saltelli' takes independent variables and a multiple of "
                f"{group} samples (variables + 2)"
            )

    def _check_given(self, kind: str) -> None:
        if self.correlation:
            raise ValueError(f"a {kind} has no `correlation`; give distributions")
        if self.sampler not in ("random", kind):
            raise ValueError(f"`sampler` is {self.sampler!r}, but the values form a {kind}; omit it")
        if kind == GRID:
            count = math.prod(len(levels.levels) for levels in self.variables.values())
            if count > MOST_CROSSED:
                raise ValueError(
                    f"these levels form {count} samples, expected at most {MOST_CROSSED}; give "
                    "fewer, or distributions"
                )
        else:
            columns = {name: np.asarray(column, float) for name, column in self.variables.items()}
            object.__setattr__(self, "variables", columns)
            lengths = {name: len(column) for name, column in self.variables.items()}
            if len(set(lengths.values())) > 1:
                raise ValueError(
                    "columns differ in length: "
                    + ", ".join(f"`{name}` has {length}" for name, length in lengths.items())
                )
            count = next(iter(lengths.values()))
        if self.samples not in (None, count):
            raise ValueError(f"`samples` is {self.samples}, but the {kind} has {count}; omit `samples`")
        object.__setattr__(self, "sampler", kind)
        object.__setattr__(self, "samples", count)

    def _cholesky(self) -> np.ndarray | None:
        if not self.correlation:
            return None
        names = self.names
        matrix = np.eye(len(names))
        for pair, value in self.correlation.items():
            if not isinstance(pair, tuple) or len(pair) != 2:
                raise ValueError(
                    f"`correlation` has the entry {pair!r}, expected pairs of names, such as "
                    f"({names[0]!r}, {names[-1]!r}): 0.5"
                )
            advice = "give a number between -1 and 1"
            value = float(checked_known(value, f"the correlation of {pair}", (), advice=advice))
            check_names(pair, names, "`correlation` names `{}`, which does not vary")
            if len(set(pair)) != 2 or not -1 < value < 1:
                raise ValueError(
                    f"the correlation of {pair} is {value}, expected two names and a number between -1 and 1"
                )
            if (back := self.correlation.get(pair[::-1], value)) != value:
                raise ValueError(f"the correlation of {pair} is both {value} and {back}; give it once")
            i, j = map(names.index, pair)
            matrix[i, j] = matrix[j, i] = value
        try:
            return np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            raise ValueError(
                f"these correlations contradict each other: the matrix\n{matrix}\nis not positive "
                "definite; make some of them smaller"
            ) from None

    @property
    def names(self) -> Labels:
        """Return names of the varying quantities, in order."""
        return tuple(self.variables)

    def __len__(self) -> int:
        return int(self.samples)  # type: ignore[arg-type]

    def values(self, first: int = 0, last: int | None = None) -> dict[str, np.ndarray]:
        """Return name -> values of the samples `first` to `last` - 1 (default: all), shape (last -
        first,).
        """
        last = len(self) if last is None else last
        if not 0 <= first <= last <= len(self):
            raise ValueError(f"samples {first} to {last} are not among 0 to {len(self)}")
        return self._at(np.arange(first, last))

    def _at(self, index, on_device: bool = False) -> dict:
        """Return the values of samples with these indices, in order.

        Values drawn `on_device` are JAX arrays with the same bits as on the host. Grids and tables stay on
        the host.
        """
        if self.sampler == TABLE:
            return {name: column[index] for name, column in self.variables.items()}
        if self.sampler == GRID:
            shape = [len(levels.levels) for levels in self.variables.values()]
            places = np.unravel_index(index, shape)
            return {
                name: np.asarray(levels.levels)[place]
                for (name, levels), place in zip(self.variables.items(), places, strict=True)
            }
        u, values = self._drawn(jnp.asarray(index) if on_device else index), Distribution.values
        if on_device:
            values = jax.jit(values, static_argnums=0)
        return {
            name: values(distribution, u[:, i])
            for i, (name, distribution) in enumerate(self.variables.items())
        }

    def probabilities(self, first: int, last: int) -> np.ndarray:
        """Return the probabilities at which the distributions are evaluated, for samples `first` to `last` -
        1, shape (last - first, variables); NaN for grids and tables.
        """
        if self.sampler in (TABLE, GRID):
            return np.full((last - first, len(self.variables)), np.nan)
        return self._drawn(np.arange(first, last))

    def _drawn(self, index):
        draw, correlate = SAMPLERS[self.sampler], correlated
        if isinstance(index, jax.Array):
            draw, correlate = jax.jit(draw, static_argnums=(0, 2, 3)), jax.jit(correlate)
        u = draw(int(self.seed), index, len(self.variables), len(self))
        return u if self._factor is None else correlate(self._factor, u)

    def _text(self) -> str:
        lines = [
            f"Design: {len(self)} samples, {self.sampler}"
            + ("" if self.sampler in (GRID, TABLE) else f", seed {self.seed}")
        ]
        for name, what in self.variables.items():
            if isinstance(what, np.ndarray):
                shown = f"{len(what)} values from {what.min():g} to {what.max():g}"
            else:
                shown = repr(what)
            lines.append(f"  {name}: {shown}")
        lines += [
            f"  correlation of {' and '.join(pair)}: {value:g}"
            for pair, value in (self.correlation or {}).items()
        ]
        return "\n".join(lines)
