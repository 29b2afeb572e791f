"""Integrate a motion: methods, step sizes, events, starts on the constraints, samples of inputs.

`loop` contains the code of a step, of the event search and of reverse mode, which is written once and
compiled to machine code; `arrays` runs the same code on JAX arrays; `vector_fields` computes the rates. To
add a method, start in `explicit_steps.py` or `implicit_steps.py`. Open `loop/step.py` first, then
`event_search.py`.
"""
