"""Formulas as MathML, which browsers draw themselves: no script, no font and no picture is loaded."""

from docutils.nodes import SkipNode
from latex2mathml.converter import convert
from sphinx.application import Sphinx


def setup(app: Sphinx) -> dict:
    """Registers the drawing of formulas."""

    def inline(self, node):
        self.body.append(convert(node.astext()))
        raise SkipNode

    def block(self, node):
        formula = node.astext().replace(
            "{aligned}", "{align*}"
        )  # the one environment of the two that latex2mathml knows
        self.body.append(f'<div class="math">{convert(formula, display="block")}</div>')
        raise SkipNode

    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
