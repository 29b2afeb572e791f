"""A scalar program as a function of JAX, evaluated at many points by machine code."""

import jax

from jourdain_jax.integrate.loop.value_kernels import nodes_called
from jourdain_jax.kernels import host


def function(graph, outputs, inputs):
    """Values of the outputs, truth values as 0 or 1, at points, one in a row: of those of the inputs."""
    assert not host.reason_against()  # it makes LLVM and C's library known
    return jax.vmap(nodes_called(graph, outputs, inputs))
