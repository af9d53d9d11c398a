"""A trained team outside training.

How it is loaded and played may be changed here; what a run keeps is for `race.runs`.
"""
