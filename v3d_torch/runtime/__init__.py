"""Threads, memory, timing, padded batches, state, hooks and import of stages, and checks of frames."""
