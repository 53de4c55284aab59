"""Preprocessing of the next frames in a thread or a second process."""
