"""How results show themselves: their text in a console, the same in a notebook, and shapes while they are being traced."""

import html

import jax

from jourdain_jax.scene.numbers import is_traced


class Printed:
    """Base of results with a `_text()`: what `print`, a console and a notebook show."""

    def __str__(self) -> str:
        return shapes_of(self) if is_traced(self) else self._text()

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return preformatted(str(self))

    def _text(self) -> str:
        raise NotImplementedError(f"`{type(self).__name__}` does not say how it is printed; define `_text(self)`")


def preformatted(text: str) -> str:
    """A text for a notebook, its columns kept."""
    return f"<pre>{html.escape(text)}</pre>"


def shapes_of(result) -> str:
    """What can be said of a result whose numbers are not known yet."""
    shapes = [tuple(leaf.shape) for leaf in jax.tree.leaves(result) if hasattr(leaf, "shape")]
    largest = max(shapes, key=lambda shape: (len(shape), shape), default=())
    name = type(result).__name__
    return f"{name}, being traced: {len(shapes)} arrays, the largest of shape {largest}; print it outside of `jax.jit`, or use `jax.debug.print`"
