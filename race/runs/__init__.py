"""A run on disk: its directory, configuration, metrics and checkpoints.

File formats may be changed here; training hands over rows and arrays and reads them back.
"""
