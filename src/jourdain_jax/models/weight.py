"""The load of models that have only weight."""

from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.scene import Scene


class Heavy(Scene):
    """A scene whose only load is the weight of its bodies; `gravity` in m/s^2."""

    def loads(self, motion):
        return (gravity(motion, self.gravity),)
