"""Errors of derivatives, and of programs, that machine code and loops of XLA do not have."""

SECOND_ORDER_MESSAGE = (
    "`simulate` was differentiated twice with reverse mode in it (jax.hessian, grad of grad), which machine code alone has; where XLA, dense matrices or a "
    "solver of diffrax integrate, take forward mode of forward mode, `jax.jacfwd(jax.jacfwd(f))`"
)
THIRD_ORDER_MESSAGE = (
    "`simulate` was differentiated three times, and not in forward mode alone; pass backend='xla' and take forward mode of any order, "
    "`jax.jacfwd(jax.jacfwd(jax.jacfwd(f)))`"
)


class DifferentiationModeError(TypeError):
    """A motion has no derivative of the mode and order that was asked for; the text says which one it has.

    Raised where the derivative is taken, evaluated or compiled; and by functions that need numbers, such as `fit`, inside `jit`, `vmap` or a derivative.
    """


class OtherDeviceError(RuntimeError):
    """Raised where machine code would become part of a program for another process, or for a device without machine code."""

    def __init__(self, program: str) -> None:
        super().__init__(f'machine code of this process cannot be part of a program {program}; give `backend="xla"` to `jj.simulate`, or to `jj.build`')
