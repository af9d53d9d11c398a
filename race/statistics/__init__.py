"""Statistics over seeds: the unit is the run, never the episode.

An interval may be changed here, with its simulated coverage; figures and tables take it as it is.
"""
