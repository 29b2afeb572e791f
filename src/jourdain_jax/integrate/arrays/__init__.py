"""Run the loop over steps (`integrate/loop`) on JAX arrays, if there is no machine code.

`array_writer.py` evaluates the code of a step on arrays; `array_loop.py` is the loop with its
reverse mode. To change a step, edit `integrate/loop/step.py`. Open `array_loop.py` first.
"""
