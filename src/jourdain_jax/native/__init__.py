"""Scalar programs as machine code for CPUs and NVIDIA GPUs, compiled by LLVM (llvmlite; not on Windows) and
called from JAX by its foreign function interface.
"""
