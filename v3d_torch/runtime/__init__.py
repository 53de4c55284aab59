"""Threads, memory, imports, timing, padded batches, and checks of arguments."""
