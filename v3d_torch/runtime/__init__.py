"""Threads, memory, timing, and checks of what callers pass in."""
