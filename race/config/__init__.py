"""What a user sets: every setting, presets, and what values can work.

A setting is added in `settings`, its rule in `checks`; nothing here knows who reads it.
"""
