"""Numbers made of motions of models, to be differentiated."""

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj


def end_of_model(name, start, parameters, **options):
    """A number made of saved states and the end of a motion, as a function of parameters and two directions
    of the start; and where to look.
    """
    scene = jj.models.MODELS[name]()
    begun = jj.start(scene, **(scene.example if start is None else start))
    x = jnp.array([float(getattr(scene, p)) for p in parameters] + [0.0, 0.0])
    q, u = (jnp.asarray(np.random.default_rng(0).normal(size=(2, len(part)))) for part in (begun.q, begun.u))

    def end(x):
        own = scene.replace(**{p: x[i] for i, p in enumerate(parameters)}) if parameters else scene
        state = jj.State(
            begun.t,
            begun.q + x[-2] * q[0],
            begun.u + x[-1] * u[0],
            begun.moved_q,
            begun.moved_u,
            begun.residual,
            begun.names,
            begun.guess,
        )
        motion = jj.simulate(own, state, rtol=1e-10, atol=1e-10, **options)
        return q[1] @ motion.q_end + u[1] @ motion.u_end + motion.t_end + jnp.nansum(motion.q[:3] ** 2)

    return end, x
