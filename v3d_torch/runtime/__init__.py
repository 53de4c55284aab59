"""Threads, memory, timing, padded batches, and checks of what callers pass in."""
