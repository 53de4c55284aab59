"""Scenes, sequences and inputs that several test files share."""
