"""The atlas of where methods fail: cases, methods, what became of each of their pairs, and the picture."""
