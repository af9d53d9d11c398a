"""Pictures for people: learning curves and videos.

Looks may be changed here; nothing that trains or stores imports it.
"""
