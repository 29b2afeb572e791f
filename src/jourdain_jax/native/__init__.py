"""Scalar programs as machine code of the CPU, by LLVM (llvmlite, which is optional), called from JAX by its foreign function interface."""
