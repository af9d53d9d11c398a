"""Rows of metrics handed on to other programs that show runs; none of them is needed.

`base` says what a logger is, each library has a module, `sending` decides which rows it gets and
keeps its mistakes away from the run. Another library is a module and a line in `sending.OPENERS`.
"""
