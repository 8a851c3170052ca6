"""Runs and datasets on disk: written whole, checked, read back."""
