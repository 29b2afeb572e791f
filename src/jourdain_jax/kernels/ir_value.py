"""Values of LLVM IR with operators: each operator appends an instruction."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

COMPARED = {
    "lt": ("olt", "slt"),
    "le": ("ole", "sle"),
    "gt": ("ogt", "sgt"),
    "ge": ("oge", "sge"),
    "eq": ("oeq", "eq"),
    "ne": ("une", "ne"),
}


def _operator(op: str, turned: bool = False) -> Callable[["Value", Any], "Value"]:
    """Return the method that appends the operation or comparison `op`; `turned`: with swapped operands."""

    def appended(self: "Value", other) -> "Value":
        a, b = (self.writer.literal(other, self.type), self) if turned else (self, other)
        return (self.writer.compared if op in COMPARED else self.writer.binary)(op, a, b)

    return appended


@dataclass(frozen=True, eq=False)
class Value:
    """Result of an instruction, an argument or a literal."""

    writer: Any  # the `Writer` of the module
    type: str
    name: str
    place: str = ""  # its memory location, if loaded or stored

    __add__ = __radd__ = _operator("add")
    __sub__, __rsub__ = _operator("sub"), _operator("sub", turned=True)
    __mul__ = __rmul__ = _operator("mul")
    __truediv__, __rtruediv__ = _operator("div"), _operator("div", turned=True)
    __lt__, __le__ = _operator("lt"), _operator("le")
    __gt__, __ge__ = _operator("gt"), _operator("ge")
    equals, differs = _operator("eq"), _operator("ne")  # NaN is equal to nothing
    __and__, __or__, __xor__ = _operator("and"), _operator("or"), _operator("xor")

    def __neg__(self) -> "Value":
        return self.writer.instruction(self.type, f"fneg {self.type} {self.name}")

    def __invert__(self) -> "Value":
        return self ^ -1
