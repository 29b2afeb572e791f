"""Operations on scalars as functions of NumPy arrays, entry by entry."""

from collections.abc import Callable

import numpy as np

FUNCTIONS: dict[str, Callable] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "sqrt": np.sqrt,
    "atan2": np.arctan2,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "pow": np.power,
    "logistic": lambda a: 1 / (1 + np.exp(-a)),
    "rem": np.fmod,
    "round": np.rint,
    "max": np.maximum,
    "min": np.minimum,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "is_finite": np.isfinite,
    "select": lambda c, a, b: np.where(c, b, a),
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "exp", "log", "tanh", "sinh", "cosh", "sign", "abs")},
    **{name: getattr(np, name) for name in ("exp2", "expm1", "log1p", "cbrt", "floor", "ceil")},
}
