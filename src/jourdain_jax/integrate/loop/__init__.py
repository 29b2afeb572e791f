"""The loop over steps: one source for machine code (`lanes.py: MachineWriter`) and for arrays of JAX.

    step.py        a step, its error and its size        transitions.py  jumps of state and modes at events
    adjoint.py     the way back over steps and events    record.py       what the way forth leaves for it

A sample of a batch is a lane here. Open `step.py` first, then `loop.py`; `native_motion.py` calls the result.
"""
