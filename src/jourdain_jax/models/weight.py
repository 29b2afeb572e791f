"""The load of models with weight only."""

from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.scene import Scene


class Heavy(Scene):
    """A scene on whose bodies weight acts and no other load; `gravity` in m/s^2."""

    def loads(self, motion):
        return (gravity(motion, self.gravity),)
