"""Machine code of CPUs and NVIDIA GPUs from scalar programs, by LLVM (llvmlite), called from JAX.

`ir.py` writes instructions. `math_functions.py` and `angles.py` write the functions that these call, so that
results are the same to the last bit on all machines. `host.py` compiles, `ffi.py` calls from JAX, `gpu.py`
and `nvidia.py` do so on GPUs. Nothing here knows what a program computes. Open `ir.py` first, then
`scalar_program.py`.
"""
