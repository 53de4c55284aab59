"""Compiled loops over NumPy arrays, for functions of many small tensor operations.

A kernel computes what a torch function of the package computes, its twin. The torch function defines the result: it is
the readable form, it is batched, carries gradients, and runs if numba is not installed.
"""
