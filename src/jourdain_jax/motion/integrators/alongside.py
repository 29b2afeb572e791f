"""An adjoint for first derivatives and values together."""

import diffrax


class Alongside(diffrax.ForwardMode):
    """Forward mode for first derivatives that are asked for together with the values: one run gives both."""
