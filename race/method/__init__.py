"""The paper's mathematics, arrays in, arrays out: equations, returns, genetics, exploration.

An equation may be changed without looking anywhere but at its test.
"""
