"""Errors for derivatives and programs that are not available, and their messages."""

SECOND_ORDER_MESSAGE = (
    "`simulate` was differentiated twice, with reverse mode (jax.hessian, grad of grad); only machine code "
    "supports this. With XLA, dense matrices or a diffrax solver, use `jax.jacfwd(jax.jacfwd(f))`"
)
THIRD_ORDER_MESSAGE = (
    "`simulate` was differentiated three times; third derivatives need forward mode alone: pass "
    "backend='xla' and use `jax.jacfwd(jax.jacfwd(jax.jacfwd(f)))`"
)


class DifferentiationModeError(TypeError):
    """Raised if a motion has no derivative of the requested mode and order; the text names a supported one.

    It may be raised when the derivative is taken, evaluated or compiled. Functions that need concrete
    numbers, such as `fit`, raise it inside `jit`, `vmap` or a derivative.
    """


class OtherDeviceError(RuntimeError):
    """Raised if machine code would become part of a program for another process or device."""

    def __init__(self, program: str) -> None:
        super().__init__(
            f"machine code of this process cannot be part of a program {program}; pass "
            '`backend="xla"` to `jj.simulate` or `jj.build`'
        )
