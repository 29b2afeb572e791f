"""Builder of LLVM IR text with operators on values: vectors with one number per lane, and scalars for loops.

Each of `a + b`, `a < b`, `where(c, a, b)` appends an instruction to the current function. Python numbers
become literals. No flag allows LLVM to change results, so every lane is rounded as written, whatever the
width.

On a GPU (`device`) every thread runs the same code with its own lane; the threads of a warp meet
(`together`) where the loop over steps continues.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import Any

from jourdain_jax.calculus.scalar_operations import COMPARISONS
from jourdain_jax.kernels.inline_attributes import with_inlining


def _operator(op: str, turned: bool = False) -> Callable[["Value", Any], "Value"]:
    """Return the method that appends the operation or comparison `op`; `turned`: with swapped operands."""

    def appended(self: "Value", other) -> "Value":
        a, b = (self.writer.literal(other, self.type), self) if turned else (self, other)
        return (self.writer.compared if op in COMPARISONS else self.writer.binary)(op, a, b)

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


class Writer:
    """Builder of a module of functions on vectors of `lanes` doubles.

    `fused`: whether `fma` rounds once; `threads`: number of threads that share the lanes on a CPU; `device`:
    whether the module is for a GPU. `record`: for a GPU, the number of doubles per slot of the record of
    steps (0: no record) and the maximum number of bytes of all slots; `common`: for each row of a start,
    whether all lanes of a GPU share it.
    """

    eps = 2.0**-52
    common: Sequence[bool] = ()

    def __init__(self, lanes: int, fused: bool, threads: int = 1, device: bool = False) -> None:
        self.lanes, self.fused, self.threads, self.device = lanes, fused, threads, device
        self.record = (0, 1 << 62)  # none, no limit
        # of a kernel: pointers to the lane counter and to the record, and the record's slots of each thread
        self.own: tuple[Value, Value, Value]
        self.real, self.truth, self.whole = f"<{lanes} x double>", f"<{lanes} x i1>", f"<{lanes} x i64>"
        self._lines: list[str] = []
        self._declared: dict[str, str] = {}
        self._count, self._entry = 0, 0

    @property
    def text(self) -> str:
        """Return the text of the module."""
        whole = "\n".join([*self._lines, *self._declared.values(), ""])
        return with_inlining(whole) if self.device else whole

    # functions and control

    @contextmanager
    def function(
        self, name: str, result: str, arguments: dict[str, str], how: str = "internal", attributes: str = ""
    ) -> Iterator[list[Value]]:
        """Write a function; yields its arguments (name -> type) as values."""
        self._lines.append(
            f"define {how} {result} @{name}({', '.join(f'{type} %{n}' for n, type in arguments.items())})"
            f" nounwind {attributes} {{"
        )
        self._entry = len(self._lines)
        yield [Value(self, type, f"%{n}") for n, type in arguments.items()]
        self._lines.append("}\n")

    @contextmanager
    def procedure(self, name: str, arguments: str) -> Iterator[list[Value]]:
        """Write a function without result; `arguments`: pointers, and others as `name:type`."""
        known = {"": "ptr", "real": self.real, "noalias": "ptr noalias"}
        pairs = (argument.partition(":") for argument in arguments.split())
        types = {n: known.get(type, type) for n, _, type in pairs}
        with self.function(name, "void", types, attributes="noinline") as given:
            yield given
            self.give()

    def give(self, value: Value | None = None) -> None:
        """Return from the function."""
        self._lines.append("  ret void" if value is None else f"  ret {value.type} {value.name}")

    def give_where(self, condition: Value, value: Value | None = None) -> None:
        """Return from the function if the condition holds."""
        with self.when(condition):
            self.give(value)
            self.place(self.label())

    @property
    def null(self) -> Value:
        """Return a null pointer; as the result of an XLA handler it means success."""
        return Value(self, "ptr", "null")

    def label(self) -> str:
        """Return a new label."""
        self._count += 1
        return f"at{self._count}"

    def place(self, label: str) -> None:
        """Place this label here."""
        self._lines.append(f"{label}:")

    def go(self, label: str, condition: Value | None = None, otherwise: str = "") -> None:
        """Jump to a label, or to `otherwise` if the condition does not hold."""
        self._lines.append(
            f"  br label %{label}"
            if condition is None
            else f"  br i1 {condition.name}, label %{label}, label %{otherwise}"
        )

    @contextmanager
    def when(self, condition: Value) -> Iterator[None]:
        """Run the enclosed code if the condition holds."""
        inside, after = self.label(), self.label()
        self.go(inside, condition, after)
        self.place(inside)
        yield
        self.go(after)
        self.place(after)

    @contextmanager
    def repeated(self) -> Iterator[Callable[[Value], None]]:
        """Write a loop; yields a function that leaves it if a condition holds."""
        again, after = self.label(), self.label()
        self.go(again)
        self.place(again)

        def leave(condition: Value) -> None:
            on = self.label()
            self.go(after, condition, on)
            self.place(on)

        yield leave
        self.go(again)
        self.place(after)

    @contextmanager
    def counted(self, end: Value | int, *, first: Value | int = 0) -> Iterator[Value]:
        """Write a loop over integers from `first` up to, but excluding, `end`."""
        number = self.room(type="i64")
        self.store(self.literal(first, "i64"), number)
        with self.repeated() as leave:
            now = self.load(number, type="i64")
            leave(now >= end)
            yield now
            self.store(now + 1, number)

    def each_lane(self) -> AbstractContextManager[Value]:
        """Write a loop over the lanes."""
        return self.counted(self.lanes)

    # instructions

    def instruction(self, type: str, text: str) -> Value:
        """Append an instruction and return its result."""
        self._count += 1
        self._lines.append(f"  %v{self._count} = {text}")
        return Value(self, type, f"%v{self._count}")

    def literal(self, number, type: str) -> Value:
        """Return a Python number as a literal of the given `type`; values pass unchanged."""
        if isinstance(number, Value):
            return number
        scalar = type.split(" x ")[-1].rstrip(">")
        text = (
            f"0x{struct.pack('>d', float(number)).hex().upper()}" if scalar == "double" else str(int(number))
        )
        return Value(self, type, text if scalar == type else f"splat ({scalar} {text})")

    def number(self, value: float) -> Value:
        """Return a number in all lanes."""
        return self.literal(value, self.real)

    def binary(self, op: str, a: Value, b) -> Value:
        """Return a sum, difference, product or quotient, or a bitwise operation."""
        b, prefix = self.literal(b, a.type), "f" if "double" in a.type else ""
        return self.instruction(a.type, f"{prefix}{op} {a.type} {a.name}, {b.name}")

    def compared(self, op: str, a: Value, b) -> Value:
        """Return a comparison; with NaN only `ne` holds."""
        b, found = self.literal(b, a.type), self.truth if a.type.startswith("<") else "i1"
        signed = "" if op in ("eq", "ne") else "s"
        how = f"fcmp {'u' if op == 'ne' else 'o'}" if "double" in a.type else f"icmp {signed}"
        return self.instruction(found, f"{how}{op} {a.type} {a.name}, {b.name}")

    def is_nan(self, a: Value) -> Value:
        """Return whether a number is NaN."""
        return self.instruction(self.truth, f"fcmp uno {a.type} {a.name}, {a.name}")

    def where(self, condition: Value, a, b) -> Value:
        """Return a where the condition holds, otherwise b."""
        like = a if isinstance(a, Value) else b if isinstance(b, Value) else self.number(0.0)
        a, b = self.literal(a, like.type), self.literal(b, like.type)
        return self.instruction(
            a.type, f"select {condition.type} {condition.name}, {a.type} {a.name}, {b.type} {b.name}"
        )

    def call(self, function: str | Value, result: str, *arguments: Value) -> Value:
        """Call a function, given by name or pointer, and return its result."""
        name = function.name if isinstance(function, Value) else f"@{function}"
        return self.instruction(
            result, f"call {result} {name}({', '.join(f'{a.type} {a.name}' for a in arguments)})"
        )

    def run(self, function: str, *arguments: Value) -> None:
        """Call a function that returns nothing."""
        self._lines.append(f"  call void @{function}({', '.join(f'{a.type} {a.name}' for a in arguments)})")

    def barrier(self) -> None:
        """Let LLVM assume that any memory may change here."""
        self._lines.append('  call void asm sideeffect "", "~{memory}"()')

    def external(self, function: str, result: str, *arguments: Value) -> Value:
        """Call a function from outside the module and return its result."""
        self._declared[function] = f"declare {result} @{function}({', '.join(a.type for a in arguments)})"
        if result == "void":
            self.run(function, *arguments)
            return Value(self, "void", "")
        return self.call(function, result, *arguments)

    def declare(self, name: str, text: str) -> None:
        """Add a declaration at the end of the module."""
        self._declared[name] = text

    def shared(self, name: str, body: Callable[..., Value], *arguments: Value) -> Value:
        """Call a function that `body(w, *arguments)` writes once per module, and return its result."""
        function = f"shared_{name}"
        self.once(
            function,
            self.real,
            {f"a{i}": a.type for i, a in enumerate(arguments)},
            lambda w, *given: w.give(body(w, *given)),
        )
        return self.call(function, self.real, *arguments)

    def once(self, function: str, result: str, arguments: dict[str, str], body: Callable) -> None:
        """Write a function once per module by `body(w, *arguments)`."""
        if function not in self._declared:
            around, self._lines = (self._lines, self._entry), []
            with self.function(function, result, arguments, attributes="noinline") as given:
                body(self, *given)
            self._declared[function] = "\n".join(self._lines)
            self._lines, self._entry = around

    def intrinsic(self, name: str, a: Value, *more) -> Value:
        """Return the result of an LLVM intrinsic of one or more numbers of one type."""
        kind = f"v{self.lanes}f64" if a.type == self.real else "f64"
        return self.external(f"llvm.{name}.{kind}", a.type, a, *(self.literal(b, a.type) for b in more))

    def fma(self, a: Value, b, c) -> Value:
        """Return a b + c, rounded once if the machine can."""
        return self.intrinsic("fma", a, b, c) if self.fused else a * b + c

    def magnitude(self, a: Value) -> Value:
        """Return |a|."""
        return self.intrinsic("fabs", a)

    def root(self, a: Value) -> Value:
        """Return the square root of a number."""
        return self.intrinsic("sqrt", a)

    def equal(self, a, b) -> Value:
        """Return whether two values are equal."""
        return a.equals(b)

    def differs(self, a, b) -> Value:
        """Return whether two values are not equal."""
        return a.differs(b)

    def smaller(self, a: Value, b) -> Value:
        """Return the smaller of two numbers, NaN if either is."""
        return self.intrinsic("minimum", a, b)

    def larger(self, a: Value, b) -> Value:
        """Return the larger of two numbers, NaN if either is."""
        return self.intrinsic("maximum", a, b)

    def converted(self, how: str, a: Value, to: str) -> Value:
        """Return an LLVM conversion, such as `sitofp`."""
        return self.instruction(to, f"{how} {a.type} {a.name} to {to}")

    def spread(self, a: Value) -> Value:
        """Return a scalar in all lanes."""
        first = self.instruction(self.real, f"insertelement {self.real} poison, double {a.name}, i64 0")
        return self.instruction(
            self.real,
            f"shufflevector {self.real} {first.name}, {self.real} poison, <{self.lanes} x i32>"
            " zeroinitializer",
        )

    def together(self, a: Value) -> Value:
        """Return whether a value is true in any thread of a warp, whose threads wait here for each other; on
        a CPU, the value itself.
        """
        everyone = self.literal(-1, "i32")
        return self.external("llvm.nvvm.vote.any.sync", "i1", everyone, a) if self.device else a

    def any(self, a: Value) -> Value:
        """Return whether a boolean holds in any lane."""
        return self.external(f"llvm.vector.reduce.or.v{self.lanes}i1", "i1", a)

    # memory

    def constants(self, name: str, numbers: Iterable, type: str = "double") -> Value:
        """Return a pointer to constants in the module."""
        texts = [f"{type} {self.literal(x, type).name}" for x in numbers]
        self._declared[name] = f"@{name} = internal constant [{len(texts)} x {type}] [{', '.join(texts)}]"
        return Value(self, "ptr", f"@{name}")

    def room(self, count: int = 1, type: str = "") -> Value:
        """Allocate stack memory for `count` values of a type (default: a vector of lanes), once per call of
        the function.
        """
        self._count += 1
        type = type or self.real
        self._lines.insert(self._entry, f"  %v{self._count} = alloca {type}, i64 {count}, align 64")
        return Value(self, "ptr", f"%v{self._count}")

    def at(self, pointer: Value, index, type: str = "") -> Value:
        """Return a pointer to the value with the given `index`."""
        type = type or self.real
        return self.instruction(
            "ptr", f"getelementptr {type}, ptr {pointer.name}, i64 {self.literal(index, 'i64').name}"
        )

    def load(self, pointer: Value, index=0, type: str = "") -> Value:
        """Return a value from memory."""
        type = type or self.real
        place = self.at(pointer, index, type).name
        return replace(self.instruction(type, f"load {type}, ptr {place}"), place=place)

    def again(self, value: Value) -> Value:
        """Return a value reloaded from memory, so that it needs no register until then; on a GPU, the
        value itself.
        """
        if self.device or not value.place:
            return value
        return self.instruction(value.type, f"load volatile {value.type}, ptr {value.place}")

    def opaque(self, pointer: Value, rows: Iterable[int]) -> list[Value]:
        """Return pointers to rows of memory, each in a register, from which LLVM reaches nearby
        rows by offsets.
        """
        assert not self.device
        found, place = [], self.room(type="ptr")
        for row in rows:
            self.store(self.at(pointer, row), place)
            found.append(self.instruction("ptr", f"load volatile ptr, ptr {place.name}"))
        return found

    def counted_up(self, pointer: Value, index, by: int) -> Value:
        """Atomically increase an integer in memory and return its old value."""
        return self.instruction(
            "i64", f"atomicrmw add ptr {self.at(pointer, index, 'i64').name}, i64 {by} monotonic"
        )

    def store(self, value, pointer: Value, index=0) -> Value:
        """Store a value, or one number for all lanes, in memory, and return it."""
        value = self.literal(value, self.real)
        place = self.at(pointer, index, value.type).name
        self._lines.append(f"  store {value.type} {value.name}, ptr {place}")
        return replace(value, place=place)
