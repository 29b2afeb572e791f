"""Explicit Runge-Kutta methods of this package's loop: tableaus and step sizes.

    k_i = f(t + c_i h, y + h sum_j a_ij k_j),   y_1 = y + h sum b_i k_i,   e = h sum (b_i - b^_i) k_i

    Tsit5:  Ch. Tsitouras, Comput. Math. Appl. 62 (2011) 770, order 5, estimate of order 4
    Dopri5: J. R. Dormand and P. J. Prince, J. Comput. Appl. Math. 6 (1980) 19, order 5, estimate by
            L. F. Shampine, Math. Comp. 46 (1986) 135
    Dopri8: P. J. Prince and J. R. Dormand, J. Comput. Appl. Math. 7 (1981) 67, order 8, estimate of order 7

Names and coefficients equal those of diffrax's solvers to the last bit, so that a motion is the same in
either loop and the default solvers do not need diffrax. The weights of the solution are also the last row of
A, so that the last stage of a step is the first stage of the next. Implicit methods use the same formulas for
step sizes. The argument `w`, the writer of a step (`integrate/loop/step.py`), evaluates the formulas on JAX
arrays or writes them as machine code.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import numpy as np

from jourdain_jax.calculus.lazy_imports import module_on_first_use
from jourdain_jax.calculus.reals import Number, is_traced, static
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.event_search import LOCATING, RUNNING

if TYPE_CHECKING:
    import diffrax
else:
    diffrax = module_on_first_use("diffrax")

SAFETY, LEAST_FACTOR, LARGEST_FACTOR = 0.9, 0.2, 10.0  # tuning


@dataclass(frozen=True, eq=False)
class Method:
    """Runge-Kutta tableau. Stages run in a loop, so that the vector field is compiled only once."""

    name: str
    order: int
    A: np.ndarray
    b: np.ndarray
    b_error: np.ndarray
    c: np.ndarray

    @property
    def needed(self) -> int:
        """Return the number of stages of a step, excluding a last stage that is not used."""
        at_y_1 = np.array_equal(self.A[-1], self.b) and self.c[-1] == 1.0
        return len(self.c) - int(at_y_1 and self.b_error[-1] == 0)

    @property
    def at_the_end(self) -> int:
        """Return the index of the last stage at the end of a step; if there is none, of the last stage."""
        return int(max(np.flatnonzero(self.c[: self.needed] == 1.0), default=self.needed - 1))


def _method(name: str, order: int, c: list, rows: list[list], b_hat: list) -> Method:
    """Return a method from its nodes and rows of A, both without the first stage, and the weights of its
    embedded method.
    """
    stages = len(c) + 1
    A = np.zeros((stages, stages))
    for i, row in enumerate(rows):
        A[i + 1, : i + 1] = row
    b = A[-1].copy()
    return Method(name, order, A, b, b - np.array(b_hat), np.array([0.0, *c]))


# fmt: off
TSIT5 = _method(
    "Tsit5",
    5,
    [0.161, 0.327, 0.9, 0.9800255409045097, 1.0, 1.0],
    [
        [0.161],
        [-0.008480655492356989, 0.335480655492357],
        [2.8971530571054935, -6.359448489975075, 4.3622954328695815],
        [5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525],
        [5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401, -0.028269050394068383],
        [0.09646076681806523, 0.01, 0.4798896504144996, 1.379008574103742, -3.290069515436081,
         2.324710524099774],
    ],
    [0.09468075576583945, 0.009183565540343254, 0.4877705284247616, 1.234297566930479, -2.7077123499835256,
     1.866628418170587, 1 / 66],
)

DOPRI5 = _method(
    "Dopri5",
    5,
    [1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0],
    [
        [1 / 5],
        [3 / 40, 9 / 40],
        [44 / 45, -56 / 15, 32 / 9],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ],
    [1951 / 21600, 0.0, 22642 / 50085, 451 / 720, -12231 / 42400, 649 / 6300, 1 / 60],
)

DOPRI8 = _method(
    "Dopri8",
    8,
    [1/18, 1/12, 1/8, 5/16, 3/8, 59/400, 93/200, 5490023248/9719169821, 13/20, 1201146811/1299019798, 1.0,
     1.0, 1.0],
    [
        [1/18],
        [1/48, 1/16],
        [1/32, 0.0, 3/32],
        [5/16, 0.0, -75/64, 75/64],
        [3/80, 0.0, 0.0, 3/16, 3/20],
        [29443841/614563906, 0.0, 0.0, 77736538/692538347, -28693883/1125000000, 23124283/1800000000],
        [16016141/946692911, 0.0, 0.0, 61564180/158732637, 22789713/633445777, 545815736/2771057229,
         -180193667/1043307555],
        [39632708/573591083, 0.0, 0.0, -433636366/683701615, -421739975/2616292301, 100302831/723423059,
         790204164/839813087, 800635310/3783071287],
        [246121993/1340847787, 0.0, 0.0, -37695042795/15268766246, -309121744/1061227803, -12992083/490766935,
         6005943493/2108947869, 393006217/1396673457, 123872331/1001029789],
        [-1028468189/846180014, 0.0, 0.0, 8478235783/508512852, 1311729495/1432422823,
         -10304129995/1701304382, -48777925059/3047939560, 15336726248/1032824649, -45442868181/3398467696,
         3065993473/597172653],
        [185892177/718116043, 0.0, 0.0, -3185094517/667107341, -477755414/1098053517, -703635378/230739211,
         5731566787/1027545527, 5232866602/850066563, -4093664535/808688257, 3962137247/1805957418,
         65686358/487910083],
        [403863854/491063109, 0.0, 0.0, -5068492393/434740067, -411421997/543043805, 652783627/914296604,
         11173962825/925320556, -13158990841/6184727034, 3936647629/1978049680, -160528059/685178525,
         248638103/1413531060, 0.0],
        [14005451/335480064, 0.0, 0.0, 0.0, 0.0, -59238493/1068277825, 181606767/758867731,
         561292985/797845732, -1041891430/1371343529, 760417239/1151165299, 118820643/751138087,
         -528747749/2220607170, 1/4],
    ],
    [13451932/455176623, 0.0, 0.0, 0.0, 0.0, -808719846/976000145, 1757004468/5645159321, 656045339/265891186,
     -3867574721/1518517206, 465885868/322736535, 53011238/667516719, 2/45, 0.0, 0.0],
)
# fmt: on

_ALL = {method.name: method for method in (TSIT5, DOPRI5, DOPRI8)}


def method_of(solver) -> Method | None:
    """Return the method that equals a diffrax solver; None if this package's loop does not support the
    solver.
    """
    method = _ALL.get(type(solver).__name__)
    return method if method is not None and type(solver) is getattr(diffrax, method.name) else None


class Aim(NamedTuple):
    """Trial step."""

    t_1: Any  # its end
    h: Any  # its rounded length, so that state and time advance together
    size: Any  # its magnitude, except in an event search
    locating: Any  # whether it belongs to an event search


def shortest(span):
    """Return the length of the shortest step of a motion over a `span`, s."""
    return 1e-14 * span


def aimed(w, p, target, reach, shift) -> Aim:
    """Return the next trial step: to the `target` if a step of length `reach` suffices, half of the way if
    two such steps suffice, otherwise of length `reach`. `shift`: the step of an event search, if there is
    one.
    """
    locating, rest = w.equal(p["code"], LOCATING), w.magnitude(target - p["t"])
    lands = ~locating & (reach >= 0.999 * rest)
    size = w.where(lands, rest, w.where(2.0 * reach > rest, 0.5 * rest, reach))
    h = p["direction"] * size if shift is None else w.where(locating, shift, p["direction"] * size)
    t_1 = w.where(lands, target, p["t"] + h)
    return Aim(t_1, t_1 - p["t"], size, locating)


def judged(w, power: Callable, p, aim: Aim, error, order: int) -> tuple:
    """Return whether a step with this `error` is accepted, and the length of the next step."""
    accept = aim.locating | (error <= 1.0)
    factor = SAFETY * power(w.where(error > 0.0, error, 1e-30), -1 / order)
    factor = w.larger(w.where(error < math.inf, factor, 0.0), LEAST_FACTOR)
    proposed = w.smaller(aim.size * w.smaller(factor, w.where(accept, LARGEST_FACTOR, 1.0)), p["longest"])
    return accept, w.where(accept & (aim.size < p["h"]), w.larger(proposed, p["h"]), proposed)


def taken(w, p, aim: Aim, accept, next_h) -> dict[str, Any]:
    """Return the time, the length of the next step, the code and the counts after a step."""
    accepted = p["accepted"] + w.where(accept & ~aim.locating, 1.0, 0.0)
    rejected = p["rejected"] + w.where(accept, 0.0, 1.0)
    # the second condition: time would not advance
    too_short = next_h < shortest(w.magnitude(p["last_goal"]))
    too_short = too_short | w.equal(aim.t_1 + p["direction"] * next_h, aim.t_1)
    arrived = accept & w.equal(aim.t_1, p["last_goal"])
    code = w.where((accepted + rejected >= p["max_steps"]) & ~arrived, result_codes.MAX_STEPS, RUNNING)
    code = w.where(too_short, result_codes.STEP_TOO_SMALL, code)
    return {
        "t": w.where(accept, aim.t_1, p["t"]),
        "h": next_h,
        "code": code,
        "accepted": accepted,
        "rejected": rejected,
    }


def code_at_end(w, form, p):
    """Return the result code at the end of the loop."""
    # steps that shrank below 0.01 of their average indicate a singularity
    shrank = p["h"] * p["accepted"] < 0.01 * w.magnitude(p["t"])
    code = w.where(w.equal(p["code"], result_codes.MAX_STEPS) & shrank, result_codes.SHRANK, p["code"])
    left = w.sum_of_squares(range(form.q_and_v), lambda i: 0.0 * w.load(p.pointer, i))
    code = w.where(w.equal(left, 0.0) | w.equal(p["accepted"], 0.0), code, result_codes.NOT_FINITE)
    return w.where(w.equal(code, RUNNING), result_codes.SUCCESS, code)


def off(where: Callable, magnitude: Callable, x, rtol, atol):
    """Return an entry of a state, increased in magnitude by the tolerance of a step."""
    return x + where(x < 0.0, -1.0, 1.0) * (atol + rtol * magnitude(x))


LEAST_ORDER, MOST_ORDER = 4, 30  # tuning


class Taylor(eqx.Module):
    """Integration by Taylor series, `simulate(..., solver=jj.Taylor())`: for small scenes, tight tolerances,
    and many saved times.

    y(t + s) = sum_{k=0}^p y_k s^k, where recurrences give the coefficients, in machine code of the CPU. The
    default order is `p = ceil(1 - log(rtol)/2)`. The length of a step keeps the last two terms within the
    tolerance (Jorba and Zou). Saved states are evaluated from the series, so steps need not end there.
    Compared with Dopri8 at equal error, a single Chaplygin sleigh takes half of the time at 1e-12; scenes
    with a few hundred operations take longer.

    **Arguments:** `order`, from 4 to 30; None: chosen by the tolerance `rtol`. **Raises** ValueError from
    `simulate` without machine code, for sampled inputs, and for equations that branch or are too long.
    Forward mode also uses series, or Dopri8 if the series of second derivatives are too long. Reverse mode
    integrates the motion again by Dopri8. Source: A. Jorba and M. Zou, Experimental Mathematics 14 (2005) 99.
    """

    order: int | None = static(default=None)

    def __check_init__(self) -> None:
        if self.order is not None and (
            not isinstance(self.order, int)
            or isinstance(self.order, bool)
            or not LEAST_ORDER <= self.order <= MOST_ORDER
        ):
            raise ValueError(
                f"`order` is {self.order!r}, expected a whole number from {LEAST_ORDER} to {MOST_ORDER}, or"
                " None to let the tolerance determine it"
            )


def order_for(rtol: Number) -> int:
    """Return the order `p = ceil(1 - log(rtol)/2)`, which minimises the cost per unit of time."""
    # 1e-12 is assumed for a traced tolerance
    tolerance = 1e-12 if is_traced(rtol) else float(rtol)
    return min(max(math.ceil(1 - math.log(tolerance) / 2), LEAST_ORDER), MOST_ORDER)
