"""The paper's figures: which runs they need, and what they look like with runs of one's own.

`figures` says what each figure compares, `planning` makes the runs' configurations of it, `drawing`
the picture; `paper.json` holds the paper's own numbers, read off its figures by eye. A figure may
be added in `figures` alone.
"""
