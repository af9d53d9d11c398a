"""What the shell does, from Python: train, load, evaluate, render, export.

All of it is also an attribute of `race` itself: ``race.train(...)``, ``race.load(...)``. `run` is a
run and what it holds, `commands` are the functions.
"""
