"""Threads, memory, timing, padded batches, and checks of arguments."""
