"""Integration of a motion: methods, step sizes, events, starts on the constraints, samples of inputs.

`loop` is the one source of a step, of the search for events and of reverse mode, written as machine code;
`arrays` runs that source on arrays of JAX; `vector_fields` gives the rates. A new method starts in
`explicit_steps.py` or `implicit_steps.py`. Open `loop/step.py` first, then `event_search.py`.
"""
