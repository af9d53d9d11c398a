"""What a user sets: every setting, presets, what values can work; and what programs see of it.

A setting is added in `settings`, its rule in `checks`, and stands in `shape` or `hyper` if a
compiled program reads it; nothing here knows who does.
"""
