"""Scalar programs as machine code of the CPU and of NVIDIA GPUs, by LLVM (llvmlite, which is optional), called from JAX by its foreign function interface."""
