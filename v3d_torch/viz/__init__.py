"""Figures, report pages and live views of a run."""
