"""Evaluation of people's tracks against true masks."""
