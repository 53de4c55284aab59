"""Stages of the system: their protocols, and the checks of stages of your own."""
