"""The loop over steps. The same code writes machine code (`lanes.py: MachineWriter`) and runs on JAX arrays.

    step.py        a step, its error and its size        transitions.py  jumps of state and modes at events
    adjoint.py     reverse mode                          record.py       record of the steps for reverse mode
    form.py        layout of the memory                  loop.py         all steps of all samples

A lane is the place of a vector register or an array in which one sample of a batch is integrated. Open
`step.py` first, then `loop.py`; `loop_function.py` calls the loop.
"""
