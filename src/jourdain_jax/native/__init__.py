"""Scalar programs as machine code of the CPU and of NVIDIA GPUs, by LLVM (llvmlite; not under Windows), called from JAX by its foreign function interface."""
