"""Models on which weight acts and nothing else."""

from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.scene import Scene


class Heavy(Scene):
    """A scene that its `gravity` pulls down, m/s^2."""

    def loads(self, motion):
        return (gravity(motion, self.gravity),)
