"""Simulation for forward-mode derivatives: the cheapest for up to about 30 parameters, and the one that least squares wants."""

import diffrax

from jourdain_jax.motion.batches.rollout import Rollout, rollout
from jourdain_jax.motion.integrators.alongside import Alongside
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.scene import Scene


def simulate_forward(scene: Scene, start=None, **options) -> Trajectory:
    """`simulate` with `adjoint=diffrax.ForwardMode()`: differentiable by jvp and jacfwd, to any order."""
    return simulate(scene, start, adjoint=diffrax.ForwardMode(), **options)


def simulate_alongside(scene: Scene, start=None, **options) -> Trajectory:
    """`simulate_forward` for first derivatives, by `jvp` and `jacfwd` (not `linearize`): where machine code serves, one run gives values and tangents."""
    return simulate(scene, start, adjoint=Alongside(), **options)


def rollout_forward(scene: Scene, starts=None, **options) -> Rollout:
    """`rollout` with `adjoint=diffrax.ForwardMode()`: differentiable by jvp and jacfwd, to any order."""
    return rollout(scene, starts, adjoint=diffrax.ForwardMode(), **options)
