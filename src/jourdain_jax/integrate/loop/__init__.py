"""The loop over steps: one source for machine code (`lanes.py: MachineWriter`) and for arrays of JAX.

    step.py        a step, its error and its size        transitions.py  jumps of state and modes at events
    adjoint.py     the way back over steps               record.py       the record that it reads
    form.py        the rows of numbers in memory         loop.py         all steps of all samples

A lane holds one sample of a batch while it is integrated. Open `step.py` first, then `loop.py`;
`native_motion.py` calls the result.
"""
