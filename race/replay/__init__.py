"""The replay buffer, and how minibatches of episodes are laid out.

How experience is stored may be changed here; learners see `Transition` and `Slots`.
"""
