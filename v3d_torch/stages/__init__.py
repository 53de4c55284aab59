"""Preprocessing of a frame; protocols, replacement and checks of stages."""
