"""First and second derivatives of a function in both modes, for comparison with those of its closed form."""

import jax


def with_value(derivative, f):
    """`derivative(f)`, and what `f` gives, by one compiled program."""
    return jax.jit(derivative(lambda *x: (f(*x),) * 2, has_aux=True))


def derivatives(f, x, directions):
    """Of a scalar `f` at the vector `x`, along the two rows of `directions`.

    Forwards: `f' d0` and `d1' f'' d0` by jvp of jvp. Backwards: `f'` and `f'' d0` by vjp of vjp.
    """

    def along(x):
        return jax.jvp(f, (x,), (directions[0],))[1]

    def across(x):
        gradient = jax.grad(f)(x)
        return gradient @ directions[0], gradient

    slope, curvature = jax.jvp(along, (x,), (directions[1],))
    hessian_product, gradient = jax.grad(across, has_aux=True)(x)
    return {"jvp": slope, "jvp of jvp": curvature, "vjp": gradient, "vjp of vjp": hessian_product}
