"""What a compiled function whose scene is traced was compiled for: the decisions that the numbers of some scene led to."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, fields

import jax
import numpy as np

from jourdain_jax.build.reference_parameters import reference_parameters
from jourdain_jax.build.structure import decisions_of
from jourdain_jax.scene.numbers import is_traced
from jourdain_jax.scene.scene import Scene


class Reference:
    """A scene whose numbers stand in for traced parameters of its class; a static argument of what is compiled.

    Two are equal where their scenes lead to the same decisions (`Structure.decisions`): then one program serves both. So what a call runs is decided by its own
    arguments, and not by which call was the first. Of a scene that is traced itself, the class's defaults stand in, unless a call further out has said more.
    """

    @staticmethod
    def where_free(scene: Scene, free: Collection[str]) -> "Reference":
        """That of a scene some of whose parameters, `free`, are going to change: the defaults of its class stand in for these, where it has states there."""
        defaults = {
            f.name: f.default for f in fields(scene) if f.name in free and f.default is not MISSING and np.shape(f.default) == np.shape(getattr(scene, f.name))
        }
        try:
            return Reference(scene.replace(**defaults))
        except (TypeError, ValueError):  # no numbers, or no state of the scene is found there
            return Reference(scene)

    def __init__(self, scene: Scene):
        self._scene = None if is_traced(scene) else scene
        self._key = None if self._scene is None else (jax.tree.structure(scene), decisions_of(scene), jax.config.jax_enable_x64)

    @contextmanager
    def stands_in(self) -> Iterator[None]:
        """Inside, its numbers stand in."""
        if self._scene is None:
            yield
        else:
            with reference_parameters(self._scene):
                yield

    def __hash__(self):
        return hash(self._key)

    def __eq__(self, other):
        return isinstance(other, Reference) and self._key == other._key
