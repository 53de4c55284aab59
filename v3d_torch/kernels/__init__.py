"""Kernels: compiled loops over NumPy arrays that replace functions of many small tensor operations.

Each kernel has a twin, a torch function of the package with the same result. The torch function is the definition: it
is readable, batched and differentiable, and runs if numba is not installed.
"""
