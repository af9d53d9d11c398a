"""Measurements of speed and memory on this machine; one module per subject.

A measurement may be added in a module of its own and named in `suite`; nothing imports it.
"""
