"""The tolerances of all tests, in one table by floating-point type.

A test that needs a looser one states its own number beside its reason. All are relative to the size of the
thing compared unless a test says otherwise.
"""

import numpy as np

TOLERANCES: dict[str, dict[str, float]] = {
    "float64": {
        "exact": 4e-16,  # the same operations in the same order
        "round_off": 1e-12,  # the same number by two formulas (two reductions, jvp against vjp)
        "ill_conditioned": 1e-9,  # the same, where the condition number is about 1e3
        "closed_form": 1e-10,  # a simulation at rtol = atol = 1e-12 against an exact solution
        "oracle": 1e-12,  # a closed form against the differential equation it solves
        "linearization": 1e-10,  # published matrices and eigenvalues
        "drift": 1e-9,  # an integral of the motion over a long run
        "residual": 1e-10,  # projected constraint residuals along a run
        "gradient_fd": 1e-6,  # derivative against central differences
        "gradient_simulation": 1e-5,  # the same through `simulate`
        "difference_step": 1e-5,  # relative step of those central differences
    },
    "float32": {
        "exact": 2e-7,
        "round_off": 2e-5,
        "ill_conditioned": 5e-3,
        "closed_form": 1e-3,
        "oracle": 1e-4,
        "linearization": 1e-3,
        "drift": 1e-3,
        "residual": 1e-4,
        "gradient_fd": 2e-2,
        "gradient_simulation": 5e-2,
        "difference_step": 1e-2,
    },
}


def tolerance(name, dtype=np.float64):
    """The tolerance called `name` for numbers of type `dtype`.

    **Arguments:** `name`, a key of the table; `dtype`, float64 or float32 in any spelling numpy takes.
    **Raises:** `KeyError` naming the known keys.
    """
    table = TOLERANCES[np.dtype(dtype).name]
    if name not in table:
        raise KeyError(f"no tolerance `{name}`; known: {', '.join(table)}")
    return table[name]


CLOSED_FORM, DRIFT, ILL_CONDITIONED, LINEARIZATION, RESIDUAL, ROUND_OFF = map(
    tolerance, ("closed_form", "drift", "ill_conditioned", "linearization", "residual", "round_off")
)


def relative_error(value, expected, size: float | None = None):
    """Largest |value - expected| divided by `size` (default: the largest |expected|, or 1 where that is
    zero).
    """
    value, expected = np.asarray(value), np.asarray(expected)
    scale = np.max(np.abs(expected), initial=0.0) if size is None else size
    return float(np.max(np.abs(value - expected), initial=0.0) / (scale or 1.0))
