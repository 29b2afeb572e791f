"""The loop over steps on arrays of JAX, by the source in `integrate/loop`, where there is no machine code.

`array_writer.py` renders the source; `array_loop.py` runs it, `array_adjoint.py` goes back over it. Change a
step in `integrate/loop/step.py`, not here. Open `array_loop.py` first.
"""
