"""Inlining attributes of functions in a GPU module. They make LLVM inline small functions and functions
called once, because local values stay in registers only in inlined functions.
"""

import re
from collections import Counter


def with_inlining(text: str) -> str:
    """Return the module with small functions and functions called once marked for inlining, and the others
    marked against it.
    """
    parts = {
        found[1]: found[0]
        for found in re.finditer(r"^define [^@]*@(\w+)\(.*?^\}$", text, re.DOTALL | re.MULTILINE)
    }
    calls = {name: Counter(re.findall(r"call [^@]*@(\w+)\(", part)) for name, part in parts.items()}
    sizes: dict[str, int] = {}

    def sites(name: str) -> int:
        return sum(counts[name] for counts in calls.values())

    def size(name: str) -> int:
        if name not in sizes:
            inlined = [inner for inner in calls[name] if inner in parts and is_small(inner)]
            sizes[name] = parts[name].count("\n") + sum(calls[name][inner] * size(inner) for inner in inlined)
        return sizes[name]

    def is_small(name: str) -> bool:
        # inline a function on a GPU up to 10_000 lines in total
        return sites(name) == 1 or sites(name) * size(name) <= 10_000

    for name, part in parts.items():
        if " internal " in (head := part.split("\n", 1)[0]):
            plain = head.replace(" noinline", "").replace(" alwaysinline", "").removesuffix(" {")
            text = text.replace(head, f"{plain} {'alwaysinline' if is_small(name) else 'noinline'} {{")
    return text
