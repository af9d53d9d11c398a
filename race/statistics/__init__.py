"""Statistics over seeds: the unit is the run, never the episode.

`intervals` of one mean, `stratified` numbers over several tasks, `separation` of two methods. An
interval may be changed here, with its simulated coverage; figures and tables take it as it is.
"""
