"""Networks as pytrees of weights, and gradient steps on them.

What a layer computes may be changed here; learners see functions of parameters and inputs.
"""
