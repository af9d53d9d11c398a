"""Measurements of speed and memory on this machine; one module per subject."""
